"""Bringing a scene's particles into groups of sixteen that lie near each other, and back."""

from __future__ import annotations

from math import floor

from rpg.plasticine.numba_backend.compiling import Array, inlined
from rpg.plasticine.numba_backend.simd import LANES, get, put
from rpg.plasticine.numba_backend.workspace import ADJOINT, FIXED, MATERIAL, STATE, B, C, Space, V


@inlined
def _node(x: float, grid: int) -> int:
    """The base node of a coordinate, from 0 on; anywhere within the grid for a NaN."""
    f = x * grid + 0.5
    if not f >= 0.0:
        return 0
    return floor(min(f, float(grid)))


@inlined
def sort(space: Space, groups: int, grid: int, x: Array, first: int, count: int) -> None:
    """Order particles by the row of nodes at which they are; padding comes last."""
    rows = (grid + 1) * (grid + 1)
    for row in range(rows):
        put(space.bins, row, 0)
    for i in range(first, first + count):
        row = _node(get(x, 3 * i), grid) * (grid + 1) + _node(get(x, 3 * i + 1), grid)
        put(space.bins, row, get(space.bins, row) + 1)
    total = 0
    for row in range(rows):
        here = get(space.bins, row)
        put(space.bins, row, total)
        total += here
    for i in range(count):
        at = 3 * (first + i)
        row = _node(get(x, at), grid) * (grid + 1) + _node(get(x, at + 1), grid)
        place = get(space.bins, row)
        put(space.order, place, i)
        put(space.bins, row, place + 1)
    for place in range(count, groups * LANES):
        put(space.order, place, -1)


@inlined
def _copy_in(values: Array, at: int, fields: int, target: Array, place: int) -> None:
    for field in range(fields):
        put(target, place + field * LANES, get(values, at + field))


@inlined
def load_particles(
    space: Space, first: int, last: int, scene: int, count: int,
    x: Array, v: Array, c: Array, b: Array, material: Array, mass: Array, volume: Array,
) -> None:  # fmt: skip
    """Fill groups first .. last - 1. Padding is a particle without mass and volume where the last particle is."""
    for place in range(first * LANES, last * LANES):
        i = get(space.order, place)
        group, lane = place // LANES, place % LANES
        at, fixed = group * STATE * LANES + lane, group * FIXED * LANES + lane
        padding = i < 0
        if padding:
            i = get(space.order, count - 1)
        n = scene * count + i
        _copy_in(x, 3 * n, 3, space.state, at)
        _copy_in(v, 3 * n, 3, space.state, at + V * LANES)
        _copy_in(c, 9 * n, 9, space.state, at + C * LANES)
        _copy_in(b, 6 * n, 6, space.state, at + B * LANES)
        _copy_in(material, 3 * n, 3, space.fixed, fixed + 2 * LANES)
        put(space.fixed, fixed, 0.0 if padding else get(mass, i))
        put(space.fixed, fixed + LANES, 0.0 if padding else get(volume, i))


@inlined
def _copy_out(source: Array, place: int, fields: int, values: Array, at: int) -> None:
    for field in range(fields):
        put(values, at + field, get(source, place + field * LANES))


@inlined
def store_particles(
    space: Space, slot: int, first: int, last: int, scene: int, count: int, x: Array, v: Array, c: Array, b: Array
) -> None:  # fmt: skip
    """Write groups first .. last - 1 to where their particles belong; their states begin at ``state[slot]``."""
    for place in range(first * LANES, last * LANES):
        i = get(space.order, place)
        if i >= 0:
            at = slot + place // LANES * STATE * LANES + place % LANES
            n = scene * count + i
            _copy_out(space.state, at, 3, x, 3 * n)
            _copy_out(space.state, at + V * LANES, 3, v, 3 * n)
            _copy_out(space.state, at + C * LANES, 9, c, 9 * n)
            _copy_out(space.state, at + B * LANES, 6, b, 6 * n)


@inlined
def _scale_shear(values: Array, at: int, stride: int, factor: float) -> None:
    """Multiply xy, xz and yz of a symmetric tensor."""
    put(values, at + stride, factor * get(values, at + stride))
    put(values, at + 2 * stride, factor * get(values, at + 2 * stride))
    put(values, at + 4 * stride, factor * get(values, at + 4 * stride))


@inlined
def load_adjoint(
    space: Space, first: int, last: int, scene: int, count: int, x: Array, v: Array, c: Array, b: Array
) -> None:
    """Fill the adjoints of groups first .. last - 1; inside, that of b is a symmetric tensor."""
    for place in range(first * LANES, last * LANES):
        i = get(space.order, place)
        at = place // LANES * ADJOINT * LANES + place % LANES
        if i < 0:
            for field in range(ADJOINT):
                put(space.adjoint, at + field * LANES, 0.0)
            continue
        n = scene * count + i
        _copy_in(x, 3 * n, 3, space.adjoint, at)
        _copy_in(v, 3 * n, 3, space.adjoint, at + V * LANES)
        _copy_in(c, 9 * n, 9, space.adjoint, at + C * LANES)
        _copy_in(b, 6 * n, 6, space.adjoint, at + B * LANES)
        _scale_shear(space.adjoint, at + B * LANES, LANES, 0.5)
        for field in range(MATERIAL, ADJOINT):
            put(space.adjoint, at + field * LANES, 0.0)


@inlined
def store_adjoint(
    space: Space,
    first: int,
    last: int,
    scene: int,
    count: int,
    x: Array,
    v: Array,
    c: Array,
    b: Array,
    material: Array,
) -> None:
    """Write the adjoints of groups first .. last - 1 to where their particles belong."""
    for place in range(first * LANES, last * LANES):
        i = get(space.order, place)
        if i >= 0:
            at = place // LANES * ADJOINT * LANES + place % LANES
            n = scene * count + i
            _copy_out(space.adjoint, at, 3, x, 3 * n)
            _copy_out(space.adjoint, at + V * LANES, 3, v, 3 * n)
            _copy_out(space.adjoint, at + C * LANES, 9, c, 9 * n)
            _copy_out(space.adjoint, at + B * LANES, 6, b, 6 * n)
            _copy_out(space.adjoint, at + MATERIAL * LANES, 3, material, 3 * n)
            _scale_shear(b, 6 * n, 1, 2.0)
