"""Mass on the grid at the end of an environment step, and its adjoint."""

from __future__ import annotations

from math import floor

from rpg.plasticine.numba_backend.compiling import Array, inlined, kernel
from rpg.plasticine.numba_backend.simd import get, put
from rpg.plasticine.numba_backend.surface import Vec3


@inlined
def _base(x: float, grid: int) -> tuple[int, float]:
    """Base node and the distance from it in cells, as `transfer.base_node` has it."""
    f = x * grid
    base = -1
    if f >= 0.5:
        base = floor(min(f - 0.5, grid - 3.0))
    f -= base
    # Comparisons, so that a NaN stays one.
    if f < 0.5:
        f = 0.5
    if f > 1.5:
        f = 1.5
    return base, f


@inlined
def _weights(f: float) -> Vec3:
    return (0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5))


@inlined
def _slopes(f: float) -> Vec3:
    return f - 1.5, 2.0 - 2.0 * f, f - 0.5


@kernel
def scatter_mass(x: Array, mass: Array, scenes: tuple[int, int, int], grid: int, nodes: Array) -> None:
    """Add the particles' mass to the nodes (flat, zero before) of scenes in range(*scenes); positions are flat, too."""
    count = len(mass)
    for scene in range(scenes[0], scenes[1], scenes[2]):
        for n in range(count):
            at = 3 * (scene * count + n)
            i, fx = _base(get(x, at), grid)
            j, fy = _base(get(x, at + 1), grid)
            k, fz = _base(get(x, at + 2), grid)
            wx, wy, wz = _weights(fx), _weights(fy), _weights(fz)
            m = get(mass, n)
            for a in range(max(0, -i), 3):
                for b in range(max(0, -j), 3):
                    w = m * wx[a] * wy[b]
                    row = ((scene * grid + i + a) * grid + j + b) * grid + k
                    for c in range(max(0, -k), 3):
                        put(nodes, row + c, get(nodes, row + c) + w * wz[c])


@kernel
def gather_mass_slopes(
    x: Array, mass: Array, particles: tuple[int, int], grid: int, pull: Array, gradient: Array
) -> None:
    """Adjoints of flat positions for range(*particles) of all scenes' particles, given those of the nodes."""
    count = len(mass)
    for n in range(particles[0], particles[1]):
        scene = n // count
        i, fx = _base(get(x, 3 * n), grid)
        j, fy = _base(get(x, 3 * n + 1), grid)
        k, fz = _base(get(x, 3 * n + 2), grid)
        wx, wy, wz = _weights(fx), _weights(fy), _weights(fz)
        sx, sy, sz = _slopes(fx), _slopes(fy), _slopes(fz)
        gx, gy, gz = 0.0, 0.0, 0.0
        for a in range(max(0, -i), 3):
            for b in range(max(0, -j), 3):
                row = ((scene * grid + i + a) * grid + j + b) * grid + k
                along, across = 0.0, 0.0
                for c in range(max(0, -k), 3):
                    g = get(pull, row + c)
                    along += wz[c] * g
                    across += sz[c] * g
                gx += sx[a] * wy[b] * along
                gy += wx[a] * sy[b] * along
                gz += wx[a] * wy[b] * across
        m = get(mass, n % count) * grid
        put(gradient, 3 * n, m * gx)
        put(gradient, 3 * n + 1, m * gy)
        put(gradient, 3 * n + 2, m * gz)
