"""The adjoint of one environment step: the kernel that every thread of a team runs."""

from __future__ import annotations

from rpg.plasticine.numba_backend.barrier import wait
from rpg.plasticine.numba_backend.compiling import Array, device, inlined, kernel
from rpg.plasticine.numba_backend.nodes_adjoint import update_nodes_adjoint
from rpg.plasticine.numba_backend.particles_adjoint import gather_group_adjoint, scatter_group_adjoint
from rpg.plasticine.numba_backend.scene import load_adjoint, store_adjoint
from rpg.plasticine.numba_backend.simd import get, pointer, put
from rpg.plasticine.numba_backend.step import own_groups, own_nodes
from rpg.plasticine.numba_backend.workspace import NUMBERS_OF_MOTION, Settings, Space, pointers


@device
def _move_back(settings: Settings, space: Space, thread: int, team: int, substep: int) -> None:
    """From the adjoints of the nodes of a substep to those of the velocities of the one before it.

    ``substep`` is one too large at the beginning, where there are no adjoints of nodes yet.
    """
    first, end, groups = own_groups(settings, thread, team)
    rows = (settings.grid + 1) * (settings.grid + 1)
    nodes = own_nodes(settings, thread)
    scatters, gathers = substep < settings.substeps, substep > 0
    after = get(space.used, 2 * substep) * rows if scatters else 0
    before = get(space.used, 2 * substep - 2) * rows if gathers else 0
    base = get(space.used, 2 * substep - 1) if gathers else 0
    for group in range(first, end):
        if scatters:
            scatter_group_adjoint(settings, space, thread, group, groups, substep, after)
        if gathers:
            gather_group_adjoint(settings, space, thread, group, groups, substep - 1, before, base, nodes)


@inlined
def _store_motion(settings: Settings, space: Space, team: int, gmotion: Array, m: int) -> None:
    """Add up what the threads found."""
    size = settings.tools * NUMBERS_OF_MOTION
    for substep in range(settings.substeps):
        for n in range(size):
            total = 0.0
            for thread in range(team):
                total += get(space.motion_adjoint, (substep * team + thread) * size + n)
            put(gmotion, m + substep * size + n, total)


@device
def _simulate_back(settings: Settings, space: Space, thread: int, team: int, motion: Array, m: int) -> None:
    """All substeps backwards."""
    _move_back(settings, space, thread, team, settings.substeps)
    for substep in range(settings.substeps - 1, -1, -1):
        wait(space.sync, team)
        at = m + substep * settings.tools * NUMBERS_OF_MOTION
        update_nodes_adjoint(settings, space, thread, team, substep, motion, at)
        wait(space.sync, team)
        _move_back(settings, space, thread, team, substep)


@kernel
def step_scene_adjoint(
    settings: Settings, arrays: Space, thread: int, team: int, scene: int, count: int, motion: Array,
    gx: Array, gv: Array, gc: Array, gb: Array,
    old_x: Array, old_v: Array, old_c: Array, old_b: Array, gmaterial: Array, gmotion: Array,
) -> None:  # fmt: skip
    """Adjoint of `step.step_scene`, after that has recorded the scene in the same space.

    Args:
        settings: physics.
        arrays: of the team, with those for the adjoint.
        thread: this thread's number in the team.
        team: how many threads there are.
        scene: number in the batch.
        count: particles of a scene.
        motion: of the tools, float64, flat.
        gx: adjoints of the positions after the step, of all scenes, flat; then gv, gc, gb.
        old_x: gets the adjoints of the positions before the step; then old_v, old_c, old_b.
        gmaterial: gets the adjoints of the material.
        gmotion: gets the adjoints of the motion, float64.
    """
    space = pointers(arrays)
    m = scene * settings.substeps * settings.tools * NUMBERS_OF_MOTION
    first, end, _ = own_groups(settings, thread, team)
    load_adjoint(space, first, end, scene, count, gx, gv, gc, gb)
    _simulate_back(settings, space, thread, team, pointer(motion), m)
    store_adjoint(space, first, end, scene, count, old_x, old_v, old_c, old_b, gmaterial)
    if thread == 0:
        _store_motion(settings, space, team, gmotion, m)
    wait(space.sync, team)
