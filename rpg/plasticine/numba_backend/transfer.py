"""Transfers between particles and grid nodes with quadratic B-splines, and what their adjoints need.

A particle touches three rows of three rows along z. A row's three nodes, with a fourth of zero weight, are one
vector of `shuffle`. Offsets between node and particle are in units of the cell: ``d_i = i - f`` with ``f = x / dx -
base``. The factors of a weight that belong to one direction are kept in a scratch array, lane p for particle p of a
group.
"""

from __future__ import annotations

from rpg.plasticine.numba_backend.compiling import Array, Vec, Vecs, inlined
from rpg.plasticine.numba_backend.shuffle import across_nodes, fold, load_quad, transpose
from rpg.plasticine.numba_backend.simd import LANES, everywhere, floor, get, load, select, store, store_index

# Where scratch holds what: for each direction the weight w, w d, the slope w' = dw/df and w' d at three nodes.
_W, _WD, _S, _SD = 0, 3 * LANES, 6 * LANES, 9 * LANES
_Y, _Z = 12 * LANES, 24 * LANES
# A group's sixteen fields across particles, and particle after particle.
FIELDS = 36 * LANES
QUADS = FIELDS + LANES * LANES
SCRATCH = QUADS + LANES * LANES


@inlined
def base_node(f: Vec, grid: int) -> Vec:
    """The first of three nodes around f, in cells; cut to the grid, which has a node -1 and ends at grid - 1."""
    base = floor(f - 0.5)
    # A NaN compares false and ends at the first node.
    base = select(base >= -1.0, base, -1.0)
    return select(base > grid - 3.0, grid - 3.0, base)


@inlined
def _node(scratch: Array, at: int, w: Vec, slope: Vec, d: Vec, slopes: bool) -> None:
    store(scratch, at + _W, w)
    store(scratch, at + _WD, w * d)
    if slopes:
        store(scratch, at + _S, slope)
        store(scratch, at + _SD, slope * d)


@inlined
def _axis(f: Vec, base: Vec, scratch: Array, at: int, slopes: bool) -> None:
    """Write the factors of one direction; weights stay a partition of one outside the grid, too."""
    f = f - base
    f = select(f < 0.5, 0.5, select(f > 1.5, 1.5, f))
    a, b, c = 1.5 - f, f - 1.0, f - 0.5
    _node(scratch, at, 0.5 * a * a, -a, -f, slopes)
    _node(scratch, at + LANES, 0.75 - b * b, -2.0 * b, -b, slopes)
    _node(scratch, at + 2 * LANES, 0.5 * c * c, c, 2.0 - f, slopes)


@inlined
def write_factors(
    state: Array, at: int, grid: int, scratch: Array, first: int, index: Array, place: int, slopes: bool
) -> None:
    """Weights of a group of particles with positions at ``state[at:]``, and where their rows are.

    ``index[place + p]`` becomes the number of particle p's first row (see `layout`), 16 places on its first node
    there.
    """
    x, y, z = (load(state, at) * grid, load(state, at + LANES) * grid, load(state, at + 2 * LANES) * grid)
    i, j, k = base_node(x, grid), base_node(y, grid), base_node(z, grid)
    _axis(x, i, scratch, first, slopes)
    _axis(y, j, scratch, first + _Y, slopes)
    _axis(z, k, scratch, first + _Z, slopes)
    store_index(index, place, (i + 1.0) * (grid + 1.0) + (j + 1.0))
    store_index(index, place + LANES, k + 1.0)


@inlined
def _add(nodes: Array, at: int, vec: Vec) -> None:
    store(nodes, at, load(nodes, at) + vec)


@inlined
def scatter(nodes: Array, rows: tuple[int, ...], scratch: Array, first: int, p: int) -> None:
    """Add ``w (a + Gx dx + Gy dy + Gz dz)`` of one particle to the nodes, a and the G being its four quads."""
    quads = first + QUADS + p * LANES
    x, y, z = first + p, first + _Y + p, first + _Z + p
    wz = across_nodes(scratch, z + _W, LANES)
    a = wz * load_quad(scratch, quads) + across_nodes(scratch, z + _WD, LANES) * load_quad(
        scratch, quads + 12
    )
    gx, gy = wz * load_quad(scratch, quads + 4), wz * load_quad(scratch, quads + 8)
    w0, w1, w2 = get(scratch, y), get(scratch, y + LANES), get(scratch, y + 2 * LANES)
    d0, d1, d2 = (get(scratch, y + _WD), get(scratch, y + _WD + LANES), get(scratch, y + _WD + 2 * LANES))
    w = get(scratch, x)
    q, r = w * a + get(scratch, x + _WD) * gx, w * gy
    _add(nodes, rows[0], w0 * q + d0 * r)
    _add(nodes, rows[1], w1 * q + d1 * r)
    _add(nodes, rows[2], w2 * q + d2 * r)
    w = get(scratch, x + LANES)
    q, r = w * a + get(scratch, x + _WD + LANES) * gx, w * gy
    _add(nodes, rows[3], w0 * q + d0 * r)
    _add(nodes, rows[4], w1 * q + d1 * r)
    _add(nodes, rows[5], w2 * q + d2 * r)
    w = get(scratch, x + 2 * LANES)
    q, r = w * a + get(scratch, x + _WD + 2 * LANES) * gx, w * gy
    _add(nodes, rows[6], w0 * q + d0 * r)
    _add(nodes, rows[7], w1 * q + d1 * r)
    _add(nodes, rows[8], w2 * q + d2 * r)


@inlined
def row_starts(
    table: Array, at: int, grid: int, index: Array, place: int, base: int, p: int
) -> tuple[int, ...]:
    """Where the nine rows of particle p begin in an array of quads whose first node is number -base."""
    row, node = at + get(index, place + p), base + get(index, place + LANES + p)
    second, third = row + grid + 1, row + 2 * (grid + 1)
    return (
        4 * (get(table, row) + node),
        4 * (get(table, row + 1) + node),
        4 * (get(table, row + 2) + node),
        4 * (get(table, second) + node),
        4 * (get(table, second + 1) + node),
        4 * (get(table, second + 2) + node),
        4 * (get(table, third) + node),
        4 * (get(table, third + 1) + node),
        4 * (get(table, third + 2) + node),
    )


@inlined
def _plane(nodes: Array, a: int, b: int, c: int, scratch: Array, y: int) -> tuple[Vec, Vec]:
    """Sums over three rows with the y factors w and wd."""
    u, v, w = load(nodes, a), load(nodes, b), load(nodes, c)
    return (
        get(scratch, y + _W) * u + get(scratch, y + _W + LANES) * v + get(scratch, y + _W + 2 * LANES) * w,
        get(scratch, y + _WD) * u + get(scratch, y + _WD + LANES) * v + get(scratch, y + _WD + 2 * LANES) * w,
    )


@inlined
def gather(nodes: Array, rows: tuple[int, ...], scratch: Array, first: int, p: int) -> Vec:
    """The four quads ``sum w v``, ``sum w v dx``, ``sum w v dy``, ``sum w v dz`` of one particle."""
    x, y, z = first + p, first + _Y + p, first + _Z + p
    m0, n0 = _plane(nodes, rows[0], rows[1], rows[2], scratch, y)
    m1, n1 = _plane(nodes, rows[3], rows[4], rows[5], scratch, y)
    m2, n2 = _plane(nodes, rows[6], rows[7], rows[8], scratch, y)
    w0, w1, w2 = get(scratch, x), get(scratch, x + LANES), get(scratch, x + 2 * LANES)
    d0, d1, d2 = (get(scratch, x + _WD), get(scratch, x + _WD + LANES), get(scratch, x + _WD + 2 * LANES))
    v = w0 * m0 + w1 * m1 + w2 * m2
    vx = d0 * m0 + d1 * m1 + d2 * m2
    vy = w0 * n0 + w1 * n1 + w2 * n2
    wz = across_nodes(scratch, z + _W, LANES)
    return fold(wz * v, wz * vx, wz * vy, across_nodes(scratch, z + _WD, LANES) * v)


@inlined
def _plane_slopes(nodes: Array, a: int, b: int, c: int, scratch: Array, y: int) -> Vecs:
    """Sums over three rows with the y factors s and sd."""
    u, v, w = load(nodes, a), load(nodes, b), load(nodes, c)
    return (
        get(scratch, y + _S) * u + get(scratch, y + _S + LANES) * v + get(scratch, y + _S + 2 * LANES) * w,
        get(scratch, y + _SD) * u + get(scratch, y + _SD + LANES) * v + get(scratch, y + _SD + 2 * LANES) * w,
    )


@inlined
def _add_plane(sums: Vecs, nodes: Array, a: int, b: int, c: int, scratch: Array, x: int, y: int) -> Vecs:
    """Add three rows of one x to the nine sums of `_moments`."""
    m, n = _plane(nodes, a, b, c, scratch, y)
    ms, ns = _plane_slopes(nodes, a, b, c, scratch, y)
    w, wd, s, sd = (get(scratch, x + _W), get(scratch, x + _WD), get(scratch, x + _S), get(scratch, x + _SD))
    return (
        sums[0] + s * m, sums[1] + sd * m, sums[2] + s * n,
        sums[3] + w * ms, sums[4] + wd * ms, sums[5] + w * ns,
        sums[6] + w * m, sums[7] + wd * m, sums[8] + w * n,
    )  # fmt: skip


@inlined
def _moments(nodes: Array, rows: tuple[int, ...], scratch: Array, first: int, p: int) -> Vecs:
    """Sums over the rows with the nine products of x and y factors (w, wd, s or sd) that gradients need.

    In order: (s w), (sd w), (s wd); (w s), (wd s), (w sd); (w w), (wd w), (w wd).
    """
    zero = everywhere(nodes, 0.0)
    x, y = first + p, first + _Y + p
    sums = (zero, zero, zero, zero, zero, zero, zero, zero, zero)
    sums = _add_plane(sums, nodes, rows[0], rows[1], rows[2], scratch, x, y)
    sums = _add_plane(sums, nodes, rows[3], rows[4], rows[5], scratch, x + LANES, y)
    return _add_plane(sums, nodes, rows[6], rows[7], rows[8], scratch, x + 2 * LANES, y)


@inlined
def gather_slopes(nodes: Array, rows: tuple[int, ...], scratch: Array, first: int, p: int) -> tuple[Vec, Vec]:
    """What adjoints gather: ``sum w n . (a + Gx dx + Gy dy + Gz dz)`` derived by f, and the quads of `gather`.

    n are the nodes' quads, a and G the particle's, and the offsets d are held fixed. The first result has the
    products of the four components apart, in one quad each for x, y and z.
    """
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = _moments(nodes, rows, scratch, first, p)
    quads, z = first + QUADS + p * LANES, first + _Z + p
    a, gx, gy = (load_quad(scratch, quads), load_quad(scratch, quads + 4), load_quad(scratch, quads + 8))
    gz = load_quad(scratch, quads + 12)
    w, wd = across_nodes(scratch, z + _W, LANES), across_nodes(scratch, z + _WD, LANES)
    s, sd = across_nodes(scratch, z + _S, LANES), across_nodes(scratch, z + _SD, LANES)
    slope_x = w * (a * a0 + gx * a1 + gy * a2) + wd * (gz * a0)
    slope_y = w * (a * b0 + gx * b1 + gy * b2) + wd * (gz * b0)
    slope_z = s * (a * c0 + gx * c1 + gy * c2) + sd * (gz * c0)
    return fold(slope_x, slope_y, slope_z, everywhere(nodes, 0.0)), fold(w * c0, w * c1, w * c2, wd * c0)


@inlined
def _write_column(scratch: Array, at: int, x: Vec, y: Vec, z: Vec, last: Vec) -> None:
    store(scratch, at, x)
    store(scratch, at + LANES, y)
    store(scratch, at + 2 * LANES, z)
    store(scratch, at + 3 * LANES, last)


@inlined
def write_quads(scratch: Array, first: int, a: Vecs, g: Vecs) -> None:
    """Bring four components a and a tensor g (row by row) into the order of `scatter`: quads a, and g's columns."""
    at = first + FIELDS
    zero = everywhere(scratch, 0.0)
    _write_column(scratch, at, a[0], a[1], a[2], a[3])
    _write_column(scratch, at + 4 * LANES, g[0], g[3], g[6], zero)
    _write_column(scratch, at + 8 * LANES, g[1], g[4], g[7], zero)
    _write_column(scratch, at + 12 * LANES, g[2], g[5], g[8], zero)
    transpose(scratch, at, scratch, first + QUADS)
