"""The elastoplastic material of sixteen particles (thesis 2.4; steps 1 to 3 of `rpg.plasticine.backend`).

Symmetric tensors are six vectors xx, xy, xz, yy, yz, zz; other tensors nine, row by row. Inside this module gradients
with respect to symmetric tensors are symmetric tensors themselves: off-diagonal entries stand for one place each.
"""

from __future__ import annotations

from rpg.plasticine.numba_backend.compiling import Vec, Vecs, inlined
from rpg.plasticine.numba_backend.functions import exp, log
from rpg.plasticine.numba_backend.simd import absolute, any_lane, root, select

# Smallest eigenvalue of b and variance of the deviator that the return mapping sees.
SMALLEST = 0.05**2
_SOFTENING = 1e-8
# Keeps the tangent of a rotation finite where there is nothing to rotate.
_TINY = 1e-18


@inlined
def deformation(c: Vecs, dt: float) -> Vecs:
    """A = I + dt C."""
    return (
        dt * c[0] + 1.0, dt * c[1], dt * c[2],
        dt * c[3], dt * c[4] + 1.0, dt * c[5],
        dt * c[6], dt * c[7], dt * c[8] + 1.0,
    )  # fmt: skip


@inlined
def times_symmetric(a: Vecs, b: Vecs) -> Vecs:
    """A b with a symmetric b."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
        a[0] * b[1] + a[1] * b[3] + a[2] * b[4],
        a[0] * b[2] + a[1] * b[4] + a[2] * b[5],
        a[3] * b[0] + a[4] * b[1] + a[5] * b[2],
        a[3] * b[1] + a[4] * b[3] + a[5] * b[4],
        a[3] * b[2] + a[4] * b[4] + a[5] * b[5],
        a[6] * b[0] + a[7] * b[1] + a[8] * b[2],
        a[6] * b[1] + a[7] * b[3] + a[8] * b[4],
        a[6] * b[2] + a[7] * b[4] + a[8] * b[5],
    )


@inlined
def _times_transposed(m: Vecs, a: Vecs) -> Vecs:
    """M A^T where that is symmetric."""
    return (
        m[0] * a[0] + m[1] * a[1] + m[2] * a[2],
        m[0] * a[3] + m[1] * a[4] + m[2] * a[5],
        m[0] * a[6] + m[1] * a[7] + m[2] * a[8],
        m[3] * a[3] + m[4] * a[4] + m[5] * a[5],
        m[3] * a[6] + m[4] * a[7] + m[5] * a[8],
        m[6] * a[6] + m[7] * a[7] + m[8] * a[8],
    )


@inlined
def trial_strain(b: Vecs, c: Vecs, dt: float) -> Vecs:
    """A b A^T."""
    a = deformation(c, dt)
    return _times_transposed(times_symmetric(a, b), a)


@inlined
def _rotation(p: Vec, q: Vec, pq: Vec) -> Vecs:
    """Tangent, cosine and sine of the rotation that removes the off-diagonal entry pq between p and q."""
    h = q - p
    scale = absolute(h) + root(h * h + 4.0 * pq * pq) + _TINY
    t = select(h < 0.0, -2.0 * pq, 2.0 * pq) / scale
    c = 1.0 / root(1.0 + t * t)
    return t, c, t * c


@inlined
def eigen(b: Vecs, sweeps: int) -> tuple[Vecs, Vecs]:
    """Eigenvalues (3) and eigenvectors, the columns of U (9), by cyclic Jacobi rotations."""
    b0, b1, b2, b3, b4, b5 = b
    one, zero = b0 * 0.0 + 1.0, b0 * 0.0
    u0, u1, u2, u3, u4, u5, u6, u7, u8 = (one, zero, zero, zero, one, zero, zero, zero, one)
    for _ in range(sweeps):
        t, c, s = _rotation(b0, b3, b1)
        b0, b3, b1 = b0 - t * b1, b3 + t * b1, zero
        b2, b4 = c * b2 - s * b4, s * b2 + c * b4
        u0, u1 = c * u0 - s * u1, s * u0 + c * u1
        u3, u4 = c * u3 - s * u4, s * u3 + c * u4
        u6, u7 = c * u6 - s * u7, s * u6 + c * u7
        t, c, s = _rotation(b0, b5, b2)
        b0, b5, b2 = b0 - t * b2, b5 + t * b2, zero
        b1, b4 = -s * b4, c * b4
        u0, u2 = c * u0 - s * u2, s * u0 + c * u2
        u3, u5 = c * u3 - s * u5, s * u3 + c * u5
        u6, u8 = c * u6 - s * u8, s * u6 + c * u8
        t, c, s = _rotation(b3, b5, b4)
        b3, b5, b4 = b3 - t * b4, b5 + t * b4, zero
        b1, b2 = c * b1, s * b1
        u1, u2 = c * u1 - s * u2, s * u1 + c * u2
        u4, u5 = c * u4 - s * u5, s * u4 + c * u5
        u7, u8 = c * u7 - s * u8, s * u7 + c * u8
    return (b0, b3, b5), (u0, u1, u2, u3, u4, u5, u6, u7, u8)


@inlined
def compose(values: Vecs, u: Vecs) -> Vecs:
    """U diag(values) U^T."""
    x, y, z = values
    a, b, c = u[0] * x, u[1] * y, u[2] * z
    d, e, f = u[3] * x, u[4] * y, u[5] * z
    return (
        a * u[0] + b * u[1] + c * u[2],
        a * u[3] + b * u[4] + c * u[5],
        a * u[6] + b * u[7] + c * u[8],
        d * u[3] + e * u[4] + f * u[5],
        d * u[6] + e * u[7] + f * u[8],
        u[6] * x * u[6] + u[7] * y * u[7] + u[8] * z * u[8],
    )


@inlined
def _transposed(u: Vecs) -> Vecs:
    return u[0], u[3], u[6], u[1], u[4], u[7], u[2], u[5], u[8]


@inlined
def in_frame(g: Vecs, u: Vecs) -> Vecs:
    """U^T G U of a symmetric G."""
    v = _transposed(u)
    return _times_transposed(times_symmetric(v, g), v)


@inlined
def above_smallest(x: Vec) -> Vec:
    """The eigenvalue that the return mapping sees."""
    return select(x < SMALLEST, SMALLEST, x)


@inlined
def hencky_strain(values: Vecs) -> Vecs:
    """Mean and deviator (3) of the logarithmic strain, and the deviator's norm."""
    e0, e1, e2 = (
        0.5 * log(above_smallest(values[0])),
        0.5 * log(above_smallest(values[1])),
        0.5 * log(above_smallest(values[2])),
    )
    mean = (e0 + e1 + e2) * (1.0 / 3.0)
    d0, d1, d2 = e0 - mean, e1 - mean, e2 - mean
    return mean, d0, d1, d2, root(d0 * d0 + d1 * d1 + d2 * d2 + _SOFTENING)


@inlined
def kirchhoff(h: Vecs, mu: Vec, lam: Vec) -> tuple[Vecs, Vecs, Vec]:
    """Principal Kirchhoff stresses, singular values of F, and J, from the eigenvalues of b."""
    s0, s1, s2 = (
        root(select(h[0] < 0.0, 0.0, h[0])),
        root(select(h[1] < 0.0, 0.0, h[1])),
        root(select(h[2] < 0.0, 0.0, h[2])),
    )
    j = s0 * s1 * s2
    pressure = lam * j * (j - 1.0)
    two_mu = 2.0 * mu
    stress = (
        two_mu * (h[0] - s0) + pressure,
        two_mu * (h[1] - s1) + pressure,
        two_mu * (h[2] - s2) + pressure,
    )
    return stress, (s0, s1, s2), j


@inlined
def returned(values: Vecs, hencky: Vecs, k: Vec, yields: Vec) -> Vecs:
    """Eigenvalues of b after the return mapping."""
    mean, d0, d1, d2, _ = hencky
    return (
        select(yields, exp(2.0 * (mean + k * d0)), values[0]),
        select(yields, exp(2.0 * (mean + k * d1)), values[1]),
        select(yields, exp(2.0 * (mean + k * d2)), values[2]),
    )


@inlined
def respond(trial: Vecs, values: Vecs, u: Vecs, mu: Vec, lam: Vec, strength: Vec) -> tuple[Vecs, Vecs]:
    """The new b (6) and the Kirchhoff stress (6) from the trial strain and its eigensystem."""
    hencky = hencky_strain(values)
    limit = 0.5 * strength / mu
    yields = hencky[4] > limit
    b = trial
    if any_lane(yields):
        values = returned(values, hencky, limit / hencky[4], yields)
        plastic = compose(values, u)
        b = (
            select(yields, plastic[0], trial[0]),
            select(yields, plastic[1], trial[1]),
            select(yields, plastic[2], trial[2]),
            select(yields, plastic[3], trial[3]),
            select(yields, plastic[4], trial[4]),
            select(yields, plastic[5], trial[5]),
        )
    stress, _, _ = kirchhoff(values, mu, lam)
    return b, compose(stress, u)
