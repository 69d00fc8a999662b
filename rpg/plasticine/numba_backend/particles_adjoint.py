"""The adjoint of what a group of sixteen particles does in a substep."""

from __future__ import annotations

from rpg.plasticine.numba_backend.compiling import Vec, Vecs, inlined
from rpg.plasticine.numba_backend.material_adjoint import (
    kirchhoff_again,
    respond_adjoint,
    trial_strain_adjoint,
)
from rpg.plasticine.numba_backend.particles import load3, load6, load9, momentum_field, store3, store6, store9
from rpg.plasticine.numba_backend.shuffle import transpose
from rpg.plasticine.numba_backend.simd import LANES, everywhere, load, select, store
from rpg.plasticine.numba_backend.transfer import (
    FIELDS,
    QUADS,
    SCRATCH,
    gather_slopes,
    row_starts,
    scatter,
    write_factors,
    write_quads,
)
from rpg.plasticine.numba_backend.workspace import (
    ADJOINT,
    EIGEN,
    FIXED,
    INDEX,
    MATERIAL,
    STATE,
    B,
    C,
    Settings,
    Space,
    V,
)


@inlined
def _unless_cut(x: Vec, v: Vec, g: Vec, settings: Settings) -> Vec:
    """Adjoint of a coordinate before it is cut to the domain."""
    x = x + settings.dt * v
    return select((x < 0.0) | (x > 1.0 - 3.0 / settings.grid), 0.0, g)


@inlined
def _slopes(space: Space, first: int) -> Vecs:
    """Sums over the components of the three quads of a group's slopes, which lie particle by particle."""
    at = first + FIELDS
    transpose(space.scratch, first + QUADS, space.scratch, at)
    s = load9(space.scratch, at) + load3(space.scratch, at + 9 * LANES)
    return (s[0] + s[1] + s[2] + s[3], s[4] + s[5] + s[6] + s[7], s[8] + s[9] + s[10] + s[11])


@inlined
def _add_position(space: Space, at: int, gx: Vecs, slopes: Vecs, g: Vecs, v: Vecs, grid: int) -> None:
    """Store the adjoint of the position: what there was, that of the weights, and that of the offsets under g (9)."""
    x = slopes[0] - (g[0] * v[0] + g[3] * v[1] + g[6] * v[2])
    y = slopes[1] - (g[1] * v[0] + g[4] * v[1] + g[7] * v[2])
    z = slopes[2] - (g[2] * v[0] + g[5] * v[1] + g[8] * v[2])
    store3(space.adjoint, at, (gx[0] + grid * x, gx[1] + grid * y, gx[2] + grid * z))


@inlined
def gather_group_adjoint(
    settings: Settings,
    space: Space,
    thread: int,
    group: int,
    groups: int,
    substep: int,
    t: int,
    base: int,
    nodes: int,
) -> None:
    """Scatter the adjoints of the nodes' velocities, given those of x, v, C after the substep.

    ``t`` is where the layout's table begins, ``base`` the substep's first node, ``nodes`` that of the thread's own
    grid.
    """
    at = (substep * groups + group) * STATE * LANES
    adjoint, grid = group * ADJOINT * LANES, settings.grid
    first, place = thread * SCRATCH, thread * INDEX
    x, v = load3(space.state, at), load3(space.state, at + (groups * STATE + V) * LANES)
    gx, gv = load3(space.adjoint, adjoint), load3(space.adjoint, adjoint + V * LANES)
    gx = (
        _unless_cut(x[0], v[0], gx[0], settings),
        _unless_cut(x[1], v[1], gx[1], settings),
        _unless_cut(x[2], v[2], gx[2], settings),
    )
    dt, k = settings.dt, 4.0 * grid
    c = load9(space.adjoint, adjoint + C * LANES)
    g = (k * c[0], k * c[1], k * c[2], k * c[3], k * c[4], k * c[5], k * c[6], k * c[7], k * c[8])
    a = (gv[0] + dt * gx[0], gv[1] + dt * gx[1], gv[2] + dt * gx[2], everywhere(space.state, 0.0))
    write_factors(space.state, at, grid, space.scratch, first, space.places, place, True)
    write_quads(space.scratch, first, a, g)
    for p in range(LANES):
        rows = row_starts(space.table, t, grid, space.places, place, base, p)
        slopes, _ = gather_slopes(space.velocity, rows, space.scratch, first, p)
        rows = row_starts(space.table, t, grid, space.places, place, nodes, p)
        scatter(space.private, rows, space.scratch, first, p)
        store(space.scratch, first + QUADS + p * LANES, slopes)
    _add_position(space, adjoint, gx, _slopes(space, first), g, v, grid)


@inlined
def scatter_group_adjoint(
    settings: Settings, space: Space, thread: int, group: int, groups: int, substep: int, t: int
) -> None:
    """Adjoints of x, v, C, b before the substep and of the material, given those of the nodes and of b after it."""
    at = (substep * groups + group) * STATE * LANES
    adjoint, fixed = group * ADJOINT * LANES, group * FIXED * LANES
    kept = (substep * groups + group) * EIGEN * LANES
    first, place, grid = thread * SCRATCH, thread * INDEX, settings.grid
    mass, volume = load(space.fixed, fixed), load(space.fixed, fixed + LANES)
    mu, lam, strength = load3(space.fixed, fixed + 2 * LANES)
    values, u = load3(space.eigen, kept), load9(space.eigen, kept + 3 * LANES)
    v, c = load3(space.state, at + V * LANES), load9(space.state, at + C * LANES)
    tau = kirchhoff_again(values, u, mu, lam, strength)
    stiffness = volume * (4.0 * settings.dt * grid * grid)
    q = momentum_field(tau, c, mass, stiffness, 1.0 / grid)
    write_factors(space.state, at, grid, space.scratch, first, space.places, place, True)
    write_quads(space.scratch, first, (mass * v[0], mass * v[1], mass * v[2], mass), q)
    for p in range(LANES):
        rows = row_starts(space.table, t, grid, space.places, place, 0, p)
        slopes, quads = gather_slopes(space.pull, rows, space.scratch, first, p)
        store(space.scratch, first + QUADS + p * LANES, slopes)
        store(space.scratch, first + FIELDS + p * LANES, quads)
    fields = first + FIELDS
    transpose(space.scratch, fields, space.scratch, fields)
    gp = load3(space.scratch, fields)
    x, y, z = (
        load3(space.scratch, fields + 4 * LANES),
        load3(space.scratch, fields + 8 * LANES),
        load3(space.scratch, fields + 12 * LANES),
    )
    _add_position(space, adjoint, load3(space.adjoint, adjoint), _slopes(space, first), q, gp, grid)
    store3(space.adjoint, adjoint + V * LANES, (mass * gp[0], mass * gp[1], mass * gp[2]))
    k = stiffness * (-1.0 / grid)
    half = 0.5 * k
    gtau = (
        k * x[0], half * (y[0] + x[1]), half * (z[0] + x[2]),
        k * y[1], half * (z[1] + y[2]),
        k * z[2],
    )  # fmt: skip
    gb = load6(space.adjoint, adjoint + B * LANES)
    gtrial, gmaterial = respond_adjoint(values, u, mu, lam, strength, gb, gtau)
    gb, gc = trial_strain_adjoint(load6(space.state, at + B * LANES), c, settings.dt, gtrial)
    store6(space.adjoint, adjoint + B * LANES, gb)
    m = mass * (1.0 / grid)
    gc = (
        gc[0] + m * x[0], gc[1] + m * y[0], gc[2] + m * z[0],
        gc[3] + m * x[1], gc[4] + m * y[1], gc[5] + m * z[1],
        gc[6] + m * x[2], gc[7] + m * y[2], gc[8] + m * z[2],
    )  # fmt: skip
    store9(space.adjoint, adjoint + C * LANES, gc)
    before = load3(space.adjoint, adjoint + MATERIAL * LANES)
    store3(
        space.adjoint,
        adjoint + MATERIAL * LANES,
        (before[0] + gmaterial[0], before[1] + gmaterial[1], before[2] + gmaterial[2]),
    )
