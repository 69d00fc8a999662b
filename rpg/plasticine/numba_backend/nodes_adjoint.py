"""The adjoint of the grid's part of a substep."""

from __future__ import annotations

from numba import float64

from rpg.plasticine.numba_backend.compiling import Array, device, inlined
from rpg.plasticine.numba_backend.contact import touch, touch_adjoint, wall_adjoint
from rpg.plasticine.numba_backend.layout import ROW, THREADS, head_size
from rpg.plasticine.numba_backend.nodes import (
    LEAST_MASS,
    boxes_of,
    collect,
    corner,
    inside,
    is_visited,
    velocity_at,
    write_boxes,
)
from rpg.plasticine.numba_backend.shuffle import quad_last, quad_sum, with_last
from rpg.plasticine.numba_backend.simd import everywhere, get, load, put, select, store
from rpg.plasticine.numba_backend.surface import TOOL, Vec3
from rpg.plasticine.numba_backend.workspace import NUMBERS_OF_MOTION, Settings, Space


@inlined
def _before_contact(settings: Settings, space: Space, at: int) -> Vec3:
    """A node's velocity from its momentum."""
    x, y, z = velocity_at(space.momentum, at)
    mass, (a, b, c) = float64(get(space.momentum, at + 3)), settings.gravity
    return (x / mass + settings.dt * a, y / mass + settings.dt * b, z / mass + settings.dt * c)


@inlined
def _trail(settings: Settings, space: Space, boxes: int, node: Vec3, v: Vec3, motion: Array, m: int) -> Vec3:
    """Velocity after the tools; writes down what it was before each."""
    trail = boxes + 6 * settings.tools
    for tool in range(settings.tools):
        for c in range(3):
            put(space.boxes, trail + 3 * tool + c, v[c])
        if inside(space, boxes + 6 * tool, node):
            number = m + tool * NUMBERS_OF_MOTION
            v = touch(space.tools, tool * TOOL, motion, number, settings.softness, node, v)
    return v


@device
def _visit_adjoint(
    settings: Settings, space: Space, thread: int, row: int, base: int, motion: Array, m: int, gm: int
) -> None:
    """Take the adjoints of the velocities of a row in ``pull`` back through walls and tools."""
    first, length, (i, j, k) = (get(space.rows, row), get(space.rows, row + 1), corner(space, row))
    grid, boxes = settings.grid, boxes_of(settings, thread)
    for n in range(length):
        at = 4 * (base + first + n)
        if get(space.momentum, at + 3) > LEAST_MASS:
            node = i / grid, j / grid, (k + n) / grid
            v = _trail(settings, space, boxes, node, _before_contact(settings, space, at), motion, m)
            pull = 4 * (first + n)
            g = wall_adjoint(i, j, k + n, grid, settings.floor_friction, v, velocity_at(space.pull, pull))
            for tool in range(settings.tools - 1, -1, -1):
                if inside(space, boxes + 6 * tool, node):
                    v = velocity_at(space.boxes, boxes + 6 * settings.tools + 3 * tool)
                    number = NUMBERS_OF_MOTION * tool
                    g = touch_adjoint(
                        space.tools, tool * TOOL, motion, m + number, settings.softness, node, v, g,
                        space.motion_adjoint, gm + number,
                    )  # fmt: skip
            for c in range(3):
                put(space.pull, pull + c, g[c])


@inlined
def update_nodes_adjoint(
    settings: Settings, space: Space, thread: int, team: int, substep: int, motion: Array, m: int
) -> None:
    """From what the threads scattered, adjoints of velocities, to those of momentum and mass in ``pull``."""
    write_boxes(settings, space, thread, motion, m)
    layout, base = get(space.used, 2 * substep), get(space.used, 2 * substep + 1)
    h, rows = layout * head_size(team), layout * (settings.grid + 1) ** 2 * ROW
    gm = (substep * team + thread) * settings.tools * NUMBERS_OF_MOTION
    for n in range(gm, gm + settings.tools * NUMBERS_OF_MOTION):
        put(space.motion_adjoint, n, 0.0)
    zero = everywhere(space.pull, 0.0)
    for number in range(
        get(space.head, h + THREADS + 3 * thread), get(space.head, h + THREADS + 3 * thread + 3)
    ):
        row = rows + ROW * number
        first, length = get(space.rows, row), get(space.rows, row + 1)
        for node in range(first, first + length, 4):
            store(space.pull, 4 * node, collect(settings, space, team, h, first, node))
        if is_visited(settings, space, thread, row):
            _visit_adjoint(settings, space, thread, row, base, motion, m, gm)
        for node in range(first, first + length, 4):
            q = load(space.momentum, 4 * (base + node))
            mass = quad_last(q)
            g = with_last(load(space.pull, 4 * node) / mass, zero)
            g = with_last(g, -quad_sum(g * q) / mass)
            store(space.pull, 4 * node, select(mass > LEAST_MASS, g, zero))
