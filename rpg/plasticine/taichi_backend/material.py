"""The material of one particle: return mapping and stress of the left Cauchy-Green tensor b, and their adjoint.

Both results are isotropic functions ``V diag(f(l)) V^T`` of the trial tensor ``V diag(l) V^T``. The adjoint of such a
function, written in the basis of the eigenvectors, multiplies the entry (i, j) of the given one by the divided
difference ``(f_i - f_j) / (l_i - l_j)``, and passes the diagonal through the derivative of f. The differences are
taken in closed form, so that equal eigenvalues (the rest state b = I) are exact and need no cases.
"""

from rpg.plasticine.taichi_backend.tensors import compose, sinhc
from rpg.plasticine.taichi_backend.types import Static, Value, func
from rpg.plasticine.taichi_module import ti

_SMALLEST = 0.05  # singular value of F that the Hencky strain sees
_SMALLEST_SQUARE = 1e-12  # eigenvalue of b of which a root is taken


@func
def flow(values: Value, mu: Value, yield_stress: Value, real: Static) -> Value:
    """Return mapping of von Mises in the basis of the eigenvectors, from the eigenvalues of the trial b.

    Returns clamped stretches, deviator of the Hencky strain and its norm, the norm at which the material yields, and
    the singular values of F afterwards (roots).
    """
    stretch = ti.max(ti.sqrt(ti.max(values, real(0.0))), real(_SMALLEST))
    strain = ti.log(stretch)
    mean = strain.sum() / 3.0
    deviator = strain - mean
    norm = ti.sqrt(deviator.dot(deviator) + real(1e-8))
    limit = yield_stress / (2.0 * mu)
    roots = ti.sqrt(ti.max(values, real(_SMALLEST_SQUARE)))
    if norm > limit:
        roots = ti.exp(mean + deviator * (limit / norm))
    return stretch, deviator, norm, limit, roots


@func
def update(
    trial: Value, values: Value, vectors: Value, roots: Value, yields: Value, mu: Value, lam: Value
) -> Value:
    """The tensor b after the return mapping, and the Kirchhoff stress (fixed corotated).

    From the trial b, its eigenvalues and eigenvectors, the roots that `flow` found, and whether the material yields.
    """
    returned, squares = trial, values
    if yields:
        squares = roots * roots
        returned = compose(squares, vectors)
    volume = roots[0] * roots[1] * roots[2]
    stress = 2.0 * mu * (squares - roots) + lam * volume * (volume - 1.0)
    return returned, compose(stress, vectors)


@func
def update_adjoint(
    values: Value,
    vectors: Value,
    stretch: Value,
    deviator: Value,
    norm: Value,
    limit: Value,
    roots: Value,
    mu: Value,
    lam: Value,
    adjoint_b: Value,
    adjoint_stress: Value,
    real: Static,
) -> Value:
    """Adjoints of the trial b (symmetric matrix) and of (mu, lambda, yield stress), given those of `update`.

    The arguments before mu are the eigenvalues and eigenvectors, and what `flow` made of them.
    """
    volume = roots[0] * roots[1] * roots[2]
    through_b = vectors.transpose() @ adjoint_b @ vectors
    through_stress = vectors.transpose() @ adjoint_stress @ vectors
    trace = through_stress.trace()
    material = ti.Vector.zero(real, 3)
    material[1] = trace * volume * (volume - 1.0)
    for i in ti.static(range(3)):
        square = roots[i] * roots[i]
        material[0] += 2.0 * through_stress[i, i] * (square - roots[i])
        through_b[i, i] += 2.0 * mu * through_stress[i, i] * (1.0 - 0.5 / roots[i])
        through_b[i, i] += lam * trace * (2.0 * volume - 1.0) * volume / (2.0 * square)
    for i, j in ti.static(((0, 1), (0, 2), (1, 2))):
        through_b[i, j] += 2.0 * mu * through_stress[i, j] * (1.0 - 1.0 / (roots[i] + roots[j]))
        through_b[j, i] = through_b[i, j]
    if norm > limit:
        through_limit = mapping_adjoint(through_b, values, stretch, roots, deviator, norm, limit, real)
        material[0] -= through_limit * limit / mu
        material[2] = through_limit / (2.0 * mu)
    return vectors @ through_b @ vectors.transpose(), material


@func
def mapping_adjoint(
    adjoint: Static,
    values: Value,
    stretch: Value,
    roots: Value,
    deviator: Value,
    norm: Value,
    limit: Value,
    real: Static,
) -> Value:
    """Turn the adjoint of the returned b into that of the trial b, in place; the result is that of the limit.

    With the scale ``c = limit / norm`` the returned eigenvalues are ``exp(2 mean + 2 c deviator)``, and a divided
    difference is ``c (r_i r_j) / (s_i s_j) sinhc(c delta) / sinhc(delta)`` with roots r, stretches s, and
    ``delta = log(s_i / s_j)``.
    """
    scale = limit / norm
    clamped = real(_SMALLEST)
    for i, j in ti.static(((0, 1), (0, 2), (1, 2))):
        factor = real(0.0)
        if stretch[i] > clamped and stretch[j] > clamped:
            delta = deviator[i] - deviator[j]
            factor = (
                scale * roots[i] * roots[j] / (stretch[i] * stretch[j]) * sinhc(scale * delta) / sinhc(delta)
            )
        elif values[i] != values[j]:
            factor = (roots[i] * roots[i] - roots[j] * roots[j]) / (values[i] - values[j])
        adjoint[i, j] *= factor
        adjoint[j, i] = adjoint[i, j]
    strain = ti.Vector(
        [2.0 * roots[i] * roots[i] * adjoint[i, i] for i in ti.static(range(3))]
    )  # of the returned Hencky strain
    along = strain.dot(deviator)
    through = scale * (strain - deviator * (along / (norm * norm)))
    through += (strain.sum() - through.sum()) / 3.0
    for i in ti.static(range(3)):
        adjoint[i, i] = 0.0
        if stretch[i] > clamped:
            adjoint[i, i] = 0.5 * through[i] / (stretch[i] * stretch[i])
    return along / norm
