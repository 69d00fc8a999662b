"""The arrays that kernels work on, for one team of threads and one scene at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rpg.plasticine.numba_backend.compiling import Array, inlined
from rpg.plasticine.numba_backend.layout import HEAD, ROW
from rpg.plasticine.numba_backend.simd import LANES, pointer
from rpg.plasticine.numba_backend.transfer import SCRATCH
from rpg.plasticine.physics import Physics

# Fields of a group of sixteen particles, one vector each. State: x 3, v 3, C 9, b 6; its adjoint the same and mu,
# lambda, yield.
X, V, C, B, STATE = 0, 3, 6, 15, 21
MATERIAL, ADJOINT = 21, 24
# What a step does not change: mass, volume, mu, lambda, yield.
FIXED = 5
# The trial strain's eigenvalues 3 and eigenvectors 9.
EIGEN = 12
# Places in an array that threads write lie this far apart, so that they do not share a line of the cache.
APART = 16
# Numbers in `sync`: threads that arrived, times the barrier opened, whether a thread failed, and nodes wanted where
# there is no room for them.
ARRIVED, OPENED, ABORTED, WANTED = 0, APART, 2 * APART, 3 * APART
# Vectors of a group's indices.
INDEX = 6 * LANES
NUMBERS_OF_MOTION = 25


class Settings(NamedTuple):
    """What kernels know about the scene: physics, groups of particles, and the size of each thread's own grid."""

    grid: int
    substeps: int
    sweeps: int
    tools: int
    groups: int
    quads: int
    dt: float
    gravity: tuple[float, float, float]
    floor_friction: float
    softness: float


class Space(NamedTuple):
    """The arrays. Those for the adjoint are empty where only a step is asked for.

    Attributes:
        sync: see ARRIVED; shared by the threads.
        order: which particle is the i-th here, -1 for padding.
        bins: counts for sorting.
        fixed: (groups, FIXED, LANES).
        state: (slots, groups, STATE, LANES); one slot, or one for the beginning of every substep and the end.
        eigen: (substeps, groups, EIGEN, LANES), adjoint only.
        adjoint: (groups, ADJOINT, LANES), adjoint only.
        extents, reach: see `layout`.
        head, table, rows: of every layout, see `layout`.
        used: layout, and first node in velocity and momentum, of every substep.
        private: what each thread scatters; all zero between substeps.
        velocity: of the nodes after the grid's update; the last number of a quad is 1 where there is mass.
        momentum: and mass of the nodes, adjoint only.
        pull: adjoints of momentum and mass, adjoint only.
        fastest: each thread's largest node velocity, not finite where one is not.
        scratch, places: of each thread.
        tools: (tools, TOOL).
        boxes: of each thread around the tools, and the velocities of one node between them.
        motion_adjoint: (substeps, threads, tools, 25), adjoint only.
    """

    sync: Array
    order: Array
    bins: Array
    fixed: Array
    state: Array
    eigen: Array
    adjoint: Array
    extents: Array
    reach: Array
    head: Array
    table: Array
    rows: Array
    used: Array
    private: Array
    velocity: Array
    momentum: Array
    pull: Array
    fastest: Array
    scratch: Array
    places: Array
    tools: Array
    boxes: Array
    motion_adjoint: Array


@inlined
def pointers(space: Space) -> Space:
    """The same arrays as kernels pass them on."""
    return Space(
        pointer(space.sync),
        pointer(space.order),
        pointer(space.bins),
        pointer(space.fixed),
        pointer(space.state),
        pointer(space.eigen),
        pointer(space.adjoint),
        pointer(space.extents),
        pointer(space.reach),
        pointer(space.head),
        pointer(space.table),
        pointer(space.rows),
        pointer(space.used),
        pointer(space.private),
        pointer(space.velocity),
        pointer(space.momentum),
        pointer(space.pull),
        pointer(space.fastest),
        pointer(space.scratch),
        pointer(space.places),
        pointer(space.tools),
        pointer(space.boxes),
        pointer(space.motion_adjoint),
    )


def _empty(size: int, dtype: npt.DTypeLike) -> Array:
    """Uninitialised flat array on a boundary of 64 bytes; the system gives memory where it is first written."""
    kind = np.dtype(dtype)
    raw = np.empty(size * kind.itemsize + 64, np.uint8)
    skip = -raw.ctypes.data % 64
    return raw[skip : skip + size * kind.itemsize].view(kind)


def _zeros(size: int, dtype: npt.DTypeLike) -> Array:
    kind = np.dtype(dtype)
    raw = np.zeros(size * kind.itemsize + 64, np.uint8)
    skip = -raw.ctypes.data % 64
    return raw[skip : skip + size * kind.itemsize].view(kind)


def quads_of(nodes: int) -> int:
    """Numbers in a grid of so many nodes, in whole vectors."""
    return -(-4 * nodes // LANES) * LANES


# What the adjoint reads of a step that was simulated, `make_recorded`; the rest of a space is scratch.
RECORDED = ("order", "fixed", "state", "eigen", "head", "table", "rows", "used", "velocity", "momentum")


def make_recorded(physics: Physics, particles: int, team: int, nodes: int) -> dict[str, Array]:
    """Arrays of one scene that take the place of a space's for a team of at most so many threads, by `RECORDED`."""
    return _recorded(physics, particles, team, nodes, adjoint=True)


def _recorded(physics: Physics, particles: int, team: int, nodes: int, adjoint: bool) -> dict[str, Array]:
    groups, rows = -(-particles // LANES), (physics.grid + 1) ** 2
    steps, kept = (physics.substeps, physics.substeps) if adjoint else (1, 0)
    real, whole, quads = physics.dtype, np.int32, quads_of(nodes)
    arrays = (
        np.zeros(groups * LANES, whole),
        _empty(groups * FIXED * LANES, real),
        _empty((kept + 1) * groups * STATE * LANES, real),
        _empty(kept * groups * EIGEN * LANES, real),
        np.zeros(steps * (HEAD + 3 * team), np.int64),
        _empty(steps * rows, whole),
        _empty(steps * rows * ROW, whole),
        np.zeros(2 * physics.substeps, np.int64),
        _empty(steps * quads, real),
        _empty(kept * quads, real),
    )
    return dict(zip(RECORDED, arrays, strict=True))


def make_space(physics: Physics, particles: int, tools: Array, team: int, nodes: int, adjoint: bool) -> Space:
    """Allocate for a team of threads, with room for that many nodes in a substep's grid."""
    groups = -(-particles // LANES)
    rows = (physics.grid + 1) ** 2
    count = len(tools)
    kept = physics.substeps if adjoint else 0
    real, whole = physics.dtype, np.int32
    quads = quads_of(nodes)
    return Space(
        **_recorded(physics, particles, team, nodes, adjoint),
        sync=np.zeros(4 * APART, np.int64),
        bins=np.zeros(rows + 1, whole),
        adjoint=_empty((groups if adjoint else 0) * ADJOINT * LANES, real),
        extents=_empty(team * 2 * rows, whole),
        reach=np.zeros(2 * team, whole),
        private=_zeros(team * quads, real),
        pull=_empty(quads if adjoint else 0, real),
        fastest=np.zeros(team * APART, np.float64),
        scratch=_zeros(team * SCRATCH, real),
        places=np.zeros(team * INDEX, whole),
        tools=np.ascontiguousarray(tools.reshape(-1), np.float64),
        boxes=np.zeros(team * (9 * count + APART), np.float64),
        motion_adjoint=np.zeros(kept * team * count * NUMBERS_OF_MOTION, np.float64),
    )
