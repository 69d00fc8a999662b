"""The adjoint of the material, in the principal frame of the trial strain.

With an isotropic tensor function f, b = U diag(l) U^T and a gradient X = U^T G U in the principal frame, the
adjoint has the diagonal ``sum_j X_jj df_j/dl_i`` and off the diagonal X_ij times the divided difference (f_i - f_j)
/ (l_i - l_j), here in forms that are exact where eigenvalues are equal.
"""

from __future__ import annotations

from rpg.plasticine.numba_backend.compiling import Vec, Vecs, inlined
from rpg.plasticine.numba_backend.functions import sinh_ratio
from rpg.plasticine.numba_backend.material import (
    SMALLEST,
    above_smallest,
    compose,
    deformation,
    hencky_strain,
    in_frame,
    kirchhoff,
    returned,
    times_symmetric,
)
from rpg.plasticine.numba_backend.simd import absolute, any_lane, root, select

# Eigenvalues further apart than this in log strain are divided as they are.
_NEAR = 0.4


@inlined
def kirchhoff_again(values: Vecs, u: Vecs, mu: Vec, lam: Vec, strength: Vec) -> Vecs:
    """The Kirchhoff stress (6) from the eigensystem of the trial strain, as `material.respond` has it."""
    hencky = hencky_strain(values)
    limit = 0.5 * strength / mu
    yields = hencky[4] > limit
    if any_lane(yields):
        values = returned(values, hencky, limit / hencky[4], yields)
    stress, _, _ = kirchhoff(values, mu, lam)
    return compose(stress, u)


@inlined
def _secant(li: Vec, lj: Vec, hi: Vec, hj: Vec, k: Vec, apart: Vec) -> Vec:
    """(h_i - h_j) / (l_i - l_j) of a yielding particle whose eigenvalues are apart in log strain."""
    ci, cj = above_smallest(li), above_smallest(lj)
    near = absolute(apart) < _NEAR
    x = select(near, apart, 0.0)
    smooth = root(hi * hj / (ci * cj)) * sinh_ratio(k, x)
    gap = select(near, 1.0, ci - cj)
    slope = select(near, smooth, (hi - hj) / gap)
    # Below the smallest eigenvalue the return mapping sees a constant.
    cut = (li < SMALLEST) | (lj < SMALLEST)
    width = li - lj
    wide = absolute(width) > 1e-12
    return select(cut, select(wide, slope * (ci - cj) / select(wide, width, 1.0), 0.0), slope)


@inlined
def _plastic_diagonal(values: Vecs, hencky: Vecs, k: Vec, p: Vecs) -> tuple[Vecs, Vec]:
    """Adjoint of the eigenvalues of the trial strain, and of k |d|, from that of the new log strain, p (3)."""
    _, d0, d1, d2, norm = hencky
    along = p[0] * d0 + p[1] * d1 + p[2] * d2
    pull = along * k / (norm * norm)
    g0, g1, g2 = k * p[0] - pull * d0, k * p[1] - pull * d1, k * p[2] - pull * d2
    shift = (p[0] + p[1] + p[2] - g0 - g1 - g2) * (1.0 / 3.0)
    return (
        select(values[0] < SMALLEST, 0.0, 0.5 * (g0 + shift) / above_smallest(values[0])),
        select(values[1] < SMALLEST, 0.0, 0.5 * (g1 + shift) / above_smallest(values[1])),
        select(values[2] < SMALLEST, 0.0, 0.5 * (g2 + shift) / above_smallest(values[2])),
    ), along / norm


@inlined
def respond_adjoint(
    values: Vecs, u: Vecs, mu: Vec, lam: Vec, strength: Vec, gb: Vecs, gtau: Vecs
) -> tuple[Vecs, Vecs]:
    """Adjoints of the trial strain (6) and of mu, lambda, yield stress, given those of the new b and the stress."""
    hencky = hencky_strain(values)
    limit = 0.5 * strength / mu
    k = limit / hencky[4]
    yields = hencky[4] > limit
    plastic = any_lane(yields)
    h = values
    if plastic:
        h = returned(values, hencky, k, yields)
    _, s, j = kirchhoff(h, mu, lam)
    xb, xt = in_frame(gb, u), in_frame(gtau, u)
    # d tau_i / d h_i, and its divided differences, which do not cancel: 2 mu (1 - 1 / (s_i + s_j))
    trace = xt[0] + xt[3] + xt[5]
    two_mu = 2.0 * mu
    volume = trace * lam * (2.0 * j - 1.0) * j * 0.5
    r0, r1, r2 = 1.0 / positive(h[0]), 1.0 / positive(h[1]), 1.0 / positive(h[2])
    y0 = xb[0] + xt[0] * two_mu * (1.0 - 0.5 * s[0] * r0) + volume * r0
    y3 = xb[3] + xt[3] * two_mu * (1.0 - 0.5 * s[1] * r1) + volume * r1
    y5 = xb[5] + xt[5] * two_mu * (1.0 - 0.5 * s[2] * r2) + volume * r2
    y1 = xb[1] + xt[1] * two_mu * (1.0 - 1.0 / positive(s[0] + s[1]))
    y2 = xb[2] + xt[2] * two_mu * (1.0 - 1.0 / positive(s[0] + s[2]))
    y4 = xb[4] + xt[4] * two_mu * (1.0 - 1.0 / positive(s[1] + s[2]))
    gmu = 2.0 * (xt[0] * (h[0] - s[0]) + xt[3] * (h[1] - s[1]) + xt[5] * (h[2] - s[2]))
    glam = trace * j * (j - 1.0)
    gyield = 0.0 * glam
    if plastic:
        p = (2.0 * h[0] * y0, 2.0 * h[1] * y3, 2.0 * h[2] * y5)
        diagonal, glimit = _plastic_diagonal(values, hencky, k, p)
        y0, y3, y5 = (
            select(yields, diagonal[0], y0),
            select(yields, diagonal[1], y3),
            select(yields, diagonal[2], y5),
        )
        _, d0, d1, d2, _ = hencky
        y1 = select(yields, y1 * _secant(values[0], values[1], h[0], h[1], k, d0 - d1), y1)
        y2 = select(yields, y2 * _secant(values[0], values[2], h[0], h[2], k, d0 - d2), y2)
        y4 = select(yields, y4 * _secant(values[1], values[2], h[1], h[2], k, d1 - d2), y4)
        glimit = select(yields, glimit, 0.0)
        gyield = 0.5 * glimit / mu
        gmu = gmu - glimit * limit / mu
    v = (u[0], u[3], u[6], u[1], u[4], u[7], u[2], u[5], u[8])
    return in_frame((y0, y1, y2, y3, y4, y5), v), (gmu, glam, gyield)


@inlined
def positive(x: Vec) -> Vec:
    """Keeps a divisor away from zero."""
    return select(x < 1e-12, 1e-12, x)


@inlined
def trial_strain_adjoint(b: Vecs, c: Vecs, dt: float, g: Vecs) -> tuple[Vecs, Vecs]:
    """Adjoints of b (6) and C (9), given that of A b A^T."""
    a = deformation(c, dt)
    m = times_symmetric(a, b)
    two = 2.0 * dt
    # gA = 2 G A b
    gc = (
        two * (g[0] * m[0] + g[1] * m[3] + g[2] * m[6]),
        two * (g[0] * m[1] + g[1] * m[4] + g[2] * m[7]),
        two * (g[0] * m[2] + g[1] * m[5] + g[2] * m[8]),
        two * (g[1] * m[0] + g[3] * m[3] + g[4] * m[6]),
        two * (g[1] * m[1] + g[3] * m[4] + g[4] * m[7]),
        two * (g[1] * m[2] + g[3] * m[5] + g[4] * m[8]),
        two * (g[2] * m[0] + g[4] * m[3] + g[5] * m[6]),
        two * (g[2] * m[1] + g[4] * m[4] + g[5] * m[7]),
        two * (g[2] * m[2] + g[4] * m[5] + g[5] * m[8]),
    )
    return in_frame(g, a), gc
