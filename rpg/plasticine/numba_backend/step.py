"""One environment step, forwards: the kernel that every thread of a team runs."""

from __future__ import annotations

from rpg.plasticine.numba_backend.barrier import wait
from rpg.plasticine.numba_backend.compiling import Array, device, inlined, kernel
from rpg.plasticine.numba_backend.layout import NODES, ROW, SLACK, build, head_size, mark
from rpg.plasticine.numba_backend.nodes import update_nodes
from rpg.plasticine.numba_backend.particles import gather_group, scatter_group
from rpg.plasticine.numba_backend.scene import load_particles, sort, store_particles
from rpg.plasticine.numba_backend.simd import LANES, get, pointer, put
from rpg.plasticine.numba_backend.workspace import (
    APART,
    INDEX,
    NUMBERS_OF_MOTION,
    STATE,
    WANTED,
    Settings,
    Space,
    pointers,
)


@inlined
def own_groups(settings: Settings, thread: int, team: int) -> tuple[int, int, int]:
    """The first and the end of a thread's groups, and how many there are of all threads."""
    groups = settings.groups
    return groups * thread // team, groups * (thread + 1) // team, groups


@inlined
def own_nodes(settings: Settings, thread: int) -> int:
    """First node of a thread's own grid."""
    return settings.quads * thread // 4


@device
def _lay_out(settings: Settings, space: Space, thread: int, team: int, slot: int, layout: int) -> None:
    """Build a layout around the particles where they are in a slot of states."""
    first, end, groups = own_groups(settings, thread, team)
    grid = settings.grid
    rows = (grid + 1) * (grid + 1)
    at, stride = (slot * groups + first) * STATE * LANES, STATE * LANES
    mark(
        space.state,
        at,
        end - first,
        stride,
        grid,
        space.extents,
        2 * thread * rows,
        space.places,
        thread * INDEX,
    )
    wait(space.sync, team)
    if thread == 0:
        build(
            space.extents, space.reach, team, grid, space.head, layout * head_size(team),
            space.table, layout * rows, space.rows, layout * rows * ROW,
        )  # fmt: skip
    wait(space.sync, team)


@inlined
def _has_room(settings: Settings, space: Space, team: int, layout: int) -> bool:
    """Whether the nodes of a layout fit; if not, notes how many there are."""
    nodes = get(space.head, layout * head_size(team) + NODES)
    if 4 * nodes <= settings.quads:
        return True
    put(space.sync, WANTED, nodes)
    return False


@inlined
def _distance(settings: Settings, space: Space, team: int) -> float:
    """How far particles may move in this substep, in cells; not finite where a node's velocity is not."""
    total, largest = 0.0, 0.0
    for thread in range(team):
        fastest = get(space.fastest, thread * APART)
        largest = max(largest, fastest)
        total += 0.0 * fastest
    return settings.dt * settings.grid * (largest + total)


@device
def _move(
    settings: Settings, space: Space, thread: int, team: int, substep: int, record: bool,
    gathers: bool, scatters: bool, old: int, old_base: int, new: int,
) -> None:  # fmt: skip
    """Gather the last substep's velocities under layout ``old``, scatter to this one's nodes under layout ``new``."""
    first, end, groups = own_groups(settings, thread, team)
    rows = (settings.grid + 1) * (settings.grid + 1)
    nodes = own_nodes(settings, thread)
    slot = substep if record else 0
    before = slot - 1 if record else 0
    for group in range(first, end):
        if gathers:
            gather_group(settings, space, thread, group, groups, before, record, old * rows, old_base)
        if scatters:
            scatter_group(settings, space, thread, group, groups, slot, record, new * rows, nodes)


@device
def simulate(
    settings: Settings, space: Space, thread: int, team: int, record: bool, motion: Array, m: int
) -> bool:
    """All substeps of an environment step from the states in the first slot; False where the grids have no room.

    With ``record`` every substep has its own slot of states, its own nodes, and maybe its own layout, as ``used``
    says.
    """
    layout, base, end, distance = -1, 0, 0, 2.0 * SLACK
    for substep in range(settings.substeps):
        old, old_base = layout, base
        # A little less than there is room for, against rounding; the comparison is false for a NaN.
        rebuilds = not distance < 0.98 * SLACK
        gathers = substep > 0
        if rebuilds:
            if gathers:
                _move(settings, space, thread, team, substep, record, True, False, old, old_base, 0)
            layout = layout + 1 if record else 0
            _lay_out(settings, space, thread, team, substep if record else 0, layout)
            gathers, distance = False, 0.0
        if record:
            base = end
        if not _has_room(settings, space, team, layout):
            return False
        end = base + get(space.head, layout * head_size(team) + NODES)
        if thread == 0:
            put(space.used, 2 * substep, layout)
            put(space.used, 2 * substep + 1, base)
        _move(settings, space, thread, team, substep, record, gathers, True, old, old_base, layout)
        wait(space.sync, team)
        at = m + substep * settings.tools * NUMBERS_OF_MOTION
        update_nodes(settings, space, thread, team, record, layout, base, motion, at)
        wait(space.sync, team)
        distance += _distance(settings, space, team)
    _move(settings, space, thread, team, settings.substeps, record, True, False, layout, base, 0)
    return True


@device
def begin(
    settings: Settings, space: Space, thread: int, team: int, scene: int, count: int,
    x: Array, v: Array, c: Array, b: Array, material: Array, mass: Array, volume: Array,
) -> bool:  # fmt: skip
    """Load a scene; False where a thread of the team does not come."""
    if thread == 0:
        sort(space, settings.groups, settings.grid, x, scene * count, count)
    if not wait(space.sync, team):
        return False
    first, end, _ = own_groups(settings, thread, team)
    load_particles(space, first, end, scene, count, x, v, c, b, material, mass, volume)
    return True


@kernel
def step_scene(
    settings: Settings, arrays: Space, thread: int, team: int, record: bool, scene: int, count: int,
    x: Array, v: Array, c: Array, b: Array, material: Array, mass: Array, volume: Array, motion: Array,
    new_x: Array, new_v: Array, new_c: Array, new_b: Array,
) -> bool:  # fmt: skip
    """An environment step of one scene of a batch; every thread of a team runs it on the same space.

    Args:
        settings: physics.
        arrays: of the team.
        thread: this thread's number in the team.
        team: how many threads there are.
        record: keep in the space what `step_adjoint.step_scene_adjoint` needs.
        scene: number in the batch.
        count: particles of a scene.
        x: positions of all scenes, flat; then v, c, b, material likewise, mass and volume of one scene.
        motion: of the tools, float64, flat.
        new_x: gets the positions after the step; then new_v, new_c, new_b.

    Returns:
        False where there was no room for the nodes.
    """
    space, tool_motion = pointers(arrays), pointer(motion)
    if not begin(settings, space, thread, team, scene, count, x, v, c, b, material, mass, volume):
        return False
    m = scene * settings.substeps * settings.tools * NUMBERS_OF_MOTION
    if not simulate(settings, space, thread, team, record, tool_motion, m):
        return False
    first, end, groups = own_groups(settings, thread, team)
    slot = settings.substeps * groups * STATE * LANES if record else 0
    store_particles(space, slot, first, end, scene, count, new_x, new_v, new_c, new_b)
    # The next scene may not be sorted before every thread is done with the order of this one.
    wait(space.sync, team)
    return True
