"""Where a particle stands on the grid: its 27 nodes, their weights, and their places in memory.

Arrays of nodes are flat, four numbers a node: the scenes' windows one after the other (and, of what particles scatter,
one such row of windows a lane). ``window`` (B, 6) holds every scene's first node and number of nodes in x, y, z.
"""

from rpg.plasticine.taichi_backend.types import Array, Static, Value, func
from rpg.plasticine.taichi_module import ti


@func
def vector(array: Array, scene: Value, p: Value, size: Static) -> Value:
    """The numbers that an array holds of one particle."""
    return ti.Vector([array[scene, p, i] for i in ti.static(range(size))])


@func
def matrix(array: Array, scene: Value, p: Value) -> Value:
    """The 3x3 matrix that an array holds of one particle."""
    return ti.Matrix([[array[scene, p, i, j] for j in ti.static(range(3))] for i in ti.static(range(3))])


@func
def store(array: Array, scene: Value, p: Value, value: Value, size: Static) -> None:
    """Write the numbers of one particle."""
    for i in ti.static(range(size)):
        array[scene, p, i] = value[i]


@func
def store_matrix(array: Array, scene: Value, p: Value, value: Value) -> None:
    """Write the 3x3 matrix of one particle."""
    for i, j in ti.static(ti.ndrange(3, 3)):
        array[scene, p, i, j] = value[i, j]


@func
def spline(f: Value, offset: Value) -> Value:
    """Quadratic B-spline: weight of the node at this offset (0, 1, 2) for a particle at f in [1/2, 3/2)."""
    t = f - 1.5 + 0.5 * offset
    return ti.select(offset == 1, 0.75 - (f - 1.0) * (f - 1.0), 0.5 * t * t)


@func
def spline_slope(f: Value, offset: Value) -> Value:
    """Derivative of `spline` with respect to f."""
    return ti.select(offset == 1, 2.0 - 2.0 * f, f - 1.5 + 0.5 * offset)


@func
def weight_and_slope(f: Value, i: Value, j: Value, k: Value) -> Value:
    """Weight of a node and its derivative with respect to the particle's position in cells."""
    x, y, z = spline(f[0], i), spline(f[1], j), spline(f[2], k)
    slope = ti.Vector(
        [spline_slope(f[0], i) * y * z, x * spline_slope(f[1], j) * z, x * y * spline_slope(f[2], k)]
    )
    return x * y * z, slope


@func
def box_size(window: Array, scene: Value) -> Value:
    """Nodes of a window in x, y, z."""
    return ti.Vector([window[scene, 3 + i] for i in ti.static(range(3))])


@func
def stencil(f: Value, window: Array, scene: Value) -> Value:
    """The first of a particle's 27 nodes, moved inside the window whatever the position (in cells) is.

    Returns its number in memory, the position from it, the window's size, and 1 if it had to be moved.
    """
    base, rest, outside = ti.Vector.zero(ti.i32, 3), f, 0
    size = box_size(window, scene)
    for i in ti.static(range(3)):
        low = window[scene, i]
        high = low + size[i] - 3
        floor = ti.floor(f[i] - 0.5)
        if floor < low or floor > high:
            outside = 1
        index = ti.min(ti.max(ti.cast(floor, ti.i32), low), high)
        base[i] = index - low
        rest[i] = f[i] - index
    return ((scene * size[0] + base[0]) * size[1] + base[1]) * size[2] + base[2], rest, size, outside


@func
def place(first: Value, size: Value, i: Value, j: Value, k: Value) -> Value:
    """Where the four numbers of the node at this offset from the first begin."""
    return 4 * (first + (i * size[1] + j) * size[2] + k)


@func
def node_vector(array: Array, at: Value) -> Value:
    """The first three numbers of a node."""
    return ti.Vector([array[at + n] for n in ti.static(range(3))])
