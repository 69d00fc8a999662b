"""What a group of sixteen particles does in a substep: material and scatter (steps 1 to 4), then step 6."""

from __future__ import annotations

from rpg.plasticine.numba_backend.compiling import Array, Vec, Vecs, inlined
from rpg.plasticine.numba_backend.material import eigen, respond, trial_strain
from rpg.plasticine.numba_backend.shuffle import transpose
from rpg.plasticine.numba_backend.simd import LANES, load, select, store
from rpg.plasticine.numba_backend.transfer import (
    FIELDS,
    QUADS,
    SCRATCH,
    gather,
    row_starts,
    scatter,
    write_factors,
    write_quads,
)
from rpg.plasticine.numba_backend.workspace import EIGEN, FIXED, INDEX, STATE, B, C, Settings, Space, V


@inlined
def load3(array: Array, at: int) -> Vecs:
    """Three fields."""
    return load(array, at), load(array, at + LANES), load(array, at + 2 * LANES)


@inlined
def store3(array: Array, at: int, v: Vecs) -> None:
    """Three fields."""
    store(array, at, v[0])
    store(array, at + LANES, v[1])
    store(array, at + 2 * LANES, v[2])


@inlined
def load6(array: Array, at: int) -> Vecs:
    """Six fields."""
    return load3(array, at) + load3(array, at + 3 * LANES)


@inlined
def store6(array: Array, at: int, v: Vecs) -> None:
    """Six fields."""
    store3(array, at, (v[0], v[1], v[2]))
    store3(array, at + 3 * LANES, (v[3], v[4], v[5]))


@inlined
def load9(array: Array, at: int) -> Vecs:
    """Nine fields."""
    return load6(array, at) + load3(array, at + 6 * LANES)


@inlined
def store9(array: Array, at: int, v: Vecs) -> None:
    """Nine fields."""
    store6(array, at, (v[0], v[1], v[2], v[3], v[4], v[5]))
    store3(array, at + 6 * LANES, (v[6], v[7], v[8]))


@inlined
def momentum_field(tau: Vecs, c: Vecs, mass: Vec, stiffness: Vec, dx: float) -> Vecs:
    """Q of step 4 (9) per cell instead of per unit length; stiffness is ``dt volume 4 / dx^2``."""
    m, k = mass * dx, stiffness * dx
    xy, xz, yz = k * tau[1], k * tau[2], k * tau[4]
    return (
        m * c[0] - k * tau[0], m * c[1] - xy, m * c[2] - xz,
        m * c[3] - xy, m * c[4] - k * tau[3], m * c[5] - yz,
        m * c[6] - xz, m * c[7] - yz, m * c[8] - k * tau[5],
    )  # fmt: skip


@inlined
def scatter_group(
    settings: Settings,
    space: Space,
    thread: int,
    group: int,
    groups: int,
    slot: int,
    record: bool,
    t: int,
    nodes: int,
) -> None:
    """Steps 1 to 4 of a group: from its strain in ``slot`` to that in the next slot, mass and momentum to the nodes.

    ``t`` is where the layout's table begins, ``nodes`` the first node of the thread's own grid.
    """
    at = (slot * groups + group) * STATE * LANES
    fixed = group * FIXED * LANES
    mass, volume = load(space.fixed, fixed), load(space.fixed, fixed + LANES)
    mu, lam, strength = load3(space.fixed, fixed + 2 * LANES)
    c = load9(space.state, at + C * LANES)
    trial = trial_strain(load6(space.state, at + B * LANES), c, settings.dt)
    values, u = eigen(trial, settings.sweeps)
    after = at
    if record:
        kept = (slot * groups + group) * EIGEN * LANES
        store3(space.eigen, kept, values)
        store9(space.eigen, kept + 3 * LANES, u)
        after = at + groups * STATE * LANES
    b, tau = respond(trial, values, u, mu, lam, strength)
    store6(space.state, after + B * LANES, b)
    grid = settings.grid
    q = momentum_field(tau, c, mass, volume * (4.0 * settings.dt * grid * grid), 1.0 / grid)
    v = load3(space.state, at + V * LANES)
    first, place = thread * SCRATCH, thread * INDEX
    write_factors(space.state, at, grid, space.scratch, first, space.places, place, False)
    write_quads(space.scratch, first, (mass * v[0], mass * v[1], mass * v[2], mass), q)
    for p in range(LANES):
        rows = row_starts(space.table, t, grid, space.places, place, nodes, p)
        scatter(space.private, rows, space.scratch, first, p)


@inlined
def moved(x: Vec, v: Vec, settings: Settings) -> Vec:
    """A coordinate after the substep, within the domain."""
    last = 1.0 - 3.0 / settings.grid
    x = x + settings.dt * v
    return select(x < 0.0, 0.0, select(x > last, last, x))


@inlined
def gather_group(
    settings: Settings,
    space: Space,
    thread: int,
    group: int,
    groups: int,
    slot: int,
    record: bool,
    t: int,
    nodes: int,
) -> None:
    """Step 6 of a group: from the velocities of the nodes to x, v and C in the next slot.

    ``t`` is where the layout's table begins, ``nodes`` the substep's first node.
    """
    at = (slot * groups + group) * STATE * LANES
    after = at + groups * STATE * LANES if record else at
    first, place = thread * SCRATCH, thread * INDEX
    grid = settings.grid
    write_factors(space.state, at, grid, space.scratch, first, space.places, place, False)
    for p in range(LANES):
        rows = row_starts(space.table, t, grid, space.places, place, nodes, p)
        store(space.scratch, first + QUADS + p * LANES, gather(space.velocity, rows, space.scratch, first, p))
    fields = first + FIELDS
    transpose(space.scratch, first + QUADS, space.scratch, fields)
    v = load3(space.scratch, fields)
    gx, gy, gz = (
        load3(space.scratch, fields + 4 * LANES),
        load3(space.scratch, fields + 8 * LANES),
        load3(space.scratch, fields + 12 * LANES),
    )
    k = 4.0 * grid
    c = (
        k * gx[0], k * gy[0], k * gz[0],
        k * gx[1], k * gy[1], k * gz[1],
        k * gx[2], k * gy[2], k * gz[2],
    )  # fmt: skip
    x = load3(space.state, at)
    x = (moved(x[0], v[0], settings), moved(x[1], v[1], settings), moved(x[2], v[2], settings))
    store3(space.state, after, x)
    store3(space.state, after + V * LANES, v)
    store9(space.state, after + C * LANES, c)
