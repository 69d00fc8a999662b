"""The grid's part of a substep: velocities of the nodes, tools, walls (step 5 of `rpg.plasticine.backend`).

Rows of nodes are updated four nodes at a time; those that a tool or a wall can touch are then visited node by node.
"""

from __future__ import annotations

from numba import float64

from rpg.plasticine.numba_backend.compiling import Array, Vec, device, inlined
from rpg.plasticine.numba_backend.contact import reach, touch, wall
from rpg.plasticine.numba_backend.layout import ROW, THREADS, head_size
from rpg.plasticine.numba_backend.shuffle import directions, lane_max, lane_sum, quad_last, with_last
from rpg.plasticine.numba_backend.simd import absolute, everywhere, get, load, put, select, store
from rpg.plasticine.numba_backend.surface import TOOL, Vec3
from rpg.plasticine.numba_backend.workspace import APART, NUMBERS_OF_MOTION, Settings, Space

LEAST_MASS = 1e-12


@inlined
def boxes_of(settings: Settings, thread: int) -> int:
    """Where a thread's boxes begin."""
    return thread * (9 * settings.tools + APART)


@inlined
def write_boxes(settings: Settings, space: Space, thread: int, motion: Array, m: int) -> None:
    """Write down where the tools can touch."""
    at = boxes_of(settings, thread)
    for tool in range(settings.tools):
        low, high = reach(space.tools, tool * TOOL, motion, m + tool * NUMBERS_OF_MOTION, settings.softness)
        for axis in range(3):
            put(space.boxes, at + 6 * tool + axis, low[axis])
            put(space.boxes, at + 6 * tool + 3 + axis, high[axis])


@inlined
def inside(space: Space, at: int, node: Vec3) -> bool:
    """Whether a node lies in a tool's box."""
    boxes = space.boxes
    return (
        get(boxes, at) <= node[0] <= get(boxes, at + 3)
        and get(boxes, at + 1) <= node[1] <= get(boxes, at + 4)
        and get(boxes, at + 2) <= node[2] <= get(boxes, at + 5)
    )


@inlined
def corner(space: Space, row: int) -> tuple[int, int, int]:
    """Indices of a row's first node."""
    return get(space.rows, row + 2), get(space.rows, row + 3), get(space.rows, row + 4)


@inlined
def is_visited(settings: Settings, space: Space, thread: int, row: int) -> bool:
    """Whether a wall or a tool may touch a node of the row."""
    grid = settings.grid
    length, (i, j, k) = get(space.rows, row + 1), corner(space, row)
    if i < 3 or i > grid - 3 or j < 3 or j > grid - 3 or k < 3 or k + length > grid - 2:
        return True
    x, y, low, high = i / grid, j / grid, k / grid, (k + length) / grid
    at, boxes = boxes_of(settings, thread), space.boxes
    for tool in range(settings.tools):
        box = at + 6 * tool
        across = get(boxes, box) <= x <= get(boxes, box + 3) and get(boxes, box + 1) <= y <= get(
            boxes, box + 4
        )
        if across and get(boxes, box + 2) <= high and low <= get(boxes, box + 5):
            return True
    return False


@inlined
def collect(settings: Settings, space: Space, team: int, h: int, first: int, node: int) -> Vec:
    """Sum of what the threads scattered to four nodes of a row beginning at ``first``; leaves zeros behind."""
    zero = everywhere(space.private, 0.0)
    total = zero
    for thread in range(team):
        reached = h + THREADS + 3 * thread + 1
        if get(space.head, reached) <= first < get(space.head, reached + 1):
            at = thread * settings.quads + 4 * node
            total += load(space.private, at)
            store(space.private, at, zero)
    return total


@device
def _visit(settings: Settings, space: Space, thread: int, row: int, base: int, motion: Array, m: int) -> None:
    """Let tools and walls act on the nodes of a row."""
    first, length, (i, j, k) = (get(space.rows, row), get(space.rows, row + 1), corner(space, row))
    grid, boxes = settings.grid, boxes_of(settings, thread)
    for n in range(length):
        at = 4 * (base + first + n)
        if get(space.velocity, at + 3) > 0.0:
            node = i / grid, j / grid, (k + n) / grid
            v = velocity_at(space.velocity, at)
            for tool in range(settings.tools):
                if inside(space, boxes + 6 * tool, node):
                    number = m + tool * NUMBERS_OF_MOTION
                    v = touch(space.tools, tool * TOOL, motion, number, settings.softness, node, v)
            v = wall(i, j, k + n, grid, settings.floor_friction, v)
            for c in range(3):
                put(space.velocity, at + c, v[c])


@inlined
def velocity_at(nodes: Array, at: int) -> Vec3:
    """Three components in float64."""
    return (float64(get(nodes, at)), float64(get(nodes, at + 1)), float64(get(nodes, at + 2)))


@inlined
def update_nodes(
    settings: Settings,
    space: Space,
    thread: int,
    team: int,
    record: bool,
    layout: int,
    base: int,
    motion: Array,
    m: int,
) -> None:
    """Step 5 for the rows that are a thread's own; notes how fast the nodes are.

    ``base`` is the substep's first node in velocity and momentum; ``motion[m:]`` are the tools' motions in it.
    """
    write_boxes(settings, space, thread, motion, m)
    h, rows = layout * head_size(team), layout * (settings.grid + 1) ** 2 * ROW
    x, y, z = settings.gravity
    zero, one = everywhere(space.velocity, 0.0), everywhere(space.velocity, 1.0)
    fall = directions(space.velocity, settings.dt * x, settings.dt * y, settings.dt * z)
    fastest, bad = zero, zero
    for number in range(
        get(space.head, h + THREADS + 3 * thread), get(space.head, h + THREADS + 3 * thread + 3)
    ):
        row = rows + ROW * number
        first, length = get(space.rows, row), get(space.rows, row + 1)
        for node in range(first, first + length, 4):
            q = collect(settings, space, team, h, first, node)
            if record:
                store(space.momentum, 4 * (base + node), q)
            mass = quad_last(q)
            # Weights of a position that is not finite: its particle's velocity will not be either.
            bad += 0.0 * mass
            v = select(mass > LEAST_MASS, with_last(q / mass + fall, one), zero)
            store(space.velocity, 4 * (base + node), v)
        if is_visited(settings, space, thread, row):
            _visit(settings, space, thread, row, base, motion, m)
        for node in range(first, first + length, 4):
            v = with_last(load(space.velocity, 4 * (base + node)), zero)
            fastest = select(absolute(v) > fastest, absolute(v), fastest)
            bad += 0.0 * v
    put(space.fastest, thread * APART, float64(lane_max(fastest)) + float64(lane_sum(bad)))
