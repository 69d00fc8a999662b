"""Which grid nodes exist: rows along z of the nodes that particles touch, one after another in memory.

A row is numbered ``(i + 1) (grid + 1) + j + 1`` by its node indices i, j in -1 .. grid - 1, and a node in it ``k +
1``. In an array of quads, node k of a row begins at ``4 (table[row] + k + 1)``. Rows are ``4 n`` nodes long and end
in a node that no particle gives weight, so that vectors of four nodes stay within. A layout has room for particles
to move by `SLACK` cells.
"""

from __future__ import annotations

from rpg.plasticine.numba_backend.compiling import Array, inlined
from rpg.plasticine.numba_backend.simd import LANES, get, load, put, select, store_index
from rpg.plasticine.numba_backend.transfer import base_node

SLACK = 0.25
# Numbers of a layout's head: nodes, rows, then for each thread its first row, the first and the end of its nodes.
NODES, ROWS, THREADS, HEAD = 0, 1, 2, 3
# Numbers of a row: its first node in memory, how many, node index of x, y, and of z at its first node.
ROW = 5
_NOWHERE = 1 << 30


@inlined
def head_size(team: int) -> int:
    """Numbers in the head of a layout."""
    return HEAD + 3 * team


@inlined
def _write_bounds(state: Array, at: int, grid: int, index: Array, place: int) -> None:
    """First and last base node in every direction that particles of a group can get to."""
    last = 1.0 - 3.0 / grid
    for axis in range(3):
        x = load(state, at + axis * LANES)
        low = select(x > last, last, x)
        high = select(x < 0.0, 0.0, x)
        store_index(index, place + 2 * axis * LANES, base_node(low * grid - SLACK, grid) + 1.0)
        store_index(index, place + (2 * axis + 1) * LANES, base_node(high * grid + SLACK, grid) + 1.0)


@inlined
def mark(
    state: Array,
    at: int,
    groups: int,
    stride: int,
    grid: int,
    extents: Array,
    e: int,
    index: Array,
    place: int,
) -> None:
    """Write the extent in z of the base nodes of every row for groups of particles.

    Positions begin at ``state[at + group * stride]``. From ``extents[e:]`` on are the lowest node of every row,
    then the highest, which is negative where no particle can get.
    """
    rows = (grid + 1) * (grid + 1)
    for row in range(rows):
        put(extents, e + row, _NOWHERE)
        put(extents, e + rows + row, -1)
    for group in range(groups):
        _write_bounds(state, at + group * stride, grid, index, place)
        for p in range(place, place + LANES):
            low, high = get(index, p + 4 * LANES), get(index, p + 5 * LANES)
            for i in range(get(index, p), get(index, p + LANES) + 1):
                for j in range(get(index, p + 2 * LANES), get(index, p + 3 * LANES) + 1):
                    row = e + i * (grid + 1) + j
                    put(extents, row, min(get(extents, row), low))
                    put(extents, row + rows, max(get(extents, row + rows), high))


@inlined
def _gather_extents(extents: Array, team: int, rows: int, grid: int) -> None:
    """Unite the threads' extents, then give every row of nodes the extent of the base rows that reach it."""
    for row in range(rows):
        low, high = get(extents, row), get(extents, row + rows)
        for thread in range(1, team):
            low = min(low, get(extents, row + 2 * thread * rows))
            high = max(high, get(extents, row + (2 * thread + 1) * rows))
        put(extents, row, low)
        put(extents, row + rows, high)
    # A base reaches two rows further in y and in x; downwards, so that what is read is as it was.
    for step in (1, grid + 1):
        for row in range(rows - 1, step - 1, -1):
            near = row - step
            far = near - step if near >= step else near
            low = min(get(extents, row), min(get(extents, near), get(extents, far)))
            high = max(get(extents, row + rows), max(get(extents, near + rows), get(extents, far + rows)))
            put(extents, row, low)
            put(extents, row + rows, high)


@inlined
def _reached(extents: Array, thread: int, rows: int) -> tuple[int, int]:
    """First and last base row that a thread's particles reach."""
    first, last = rows, -1
    for row in range(rows):
        if get(extents, row + (2 * thread + 1) * rows) >= 0:
            first = min(first, row)
            last = row
    return first, last


@inlined
def build(
    extents: Array,
    reach: Array,
    team: int,
    grid: int,
    head: Array,
    h: int,
    table: Array,
    t: int,
    listed: Array,
    r: int,
) -> int:
    """Lay the rows out: fills a head from ``head[h:]``, a table and a list of rows. Returns the number of nodes."""
    rows = (grid + 1) * (grid + 1)
    for thread in range(team):
        first, last = _reached(extents, thread, rows)
        put(reach, 2 * thread, first)
        put(reach, 2 * thread + 1, min(last + 2 * (grid + 1) + 2, rows - 1))
        put(head, h + THREADS + 1 + 3 * thread, 0)
        put(head, h + THREADS + 2 + 3 * thread, 0)
    _gather_extents(extents, team, rows, grid)
    nodes, count = 0, 0
    for row in range(rows):
        for thread in range(team):
            if row == get(reach, 2 * thread):
                put(head, h + THREADS + 1 + 3 * thread, nodes)
        low, high = get(extents, row), get(extents, row + rows)
        put(table, t + row, 0)
        if high >= 0:
            length = (high - low + 3 + 1 + 3) // 4 * 4
            put(table, t + row, nodes - low)
            place = r + ROW * count
            put(listed, place, nodes)
            put(listed, place + 1, length)
            put(listed, place + 2, row // (grid + 1) - 1)
            put(listed, place + 3, row % (grid + 1) - 1)
            put(listed, place + 4, low - 1)
            nodes += length
            count += 1
        for thread in range(team):
            if row == get(reach, 2 * thread + 1):
                put(head, h + THREADS + 2 + 3 * thread, nodes)
    put(head, h + NODES, nodes)
    put(head, h + ROWS, count)
    _divide(listed, r, count, nodes, team, head, h)
    return nodes


@inlined
def _divide(listed: Array, r: int, count: int, nodes: int, team: int, head: Array, h: int) -> None:
    """Give every thread rows with about the same number of nodes."""
    row = 0
    for thread in range(team):
        while row < count and get(listed, r + ROW * row) * team < nodes * thread:
            row += 1
        put(head, h + THREADS + 3 * thread, row)
    put(head, h + THREADS + 3 * team, count)
