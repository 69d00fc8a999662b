"""Signed distance functions of the tools' shapes, their normals and curvature, in a tool's own frame (thesis 2.4).

A tool is a row of `TOOL` numbers: shape, friction, three sizes. Everything here is in float64: few nodes are near a
tool.
"""

from __future__ import annotations

from math import sqrt

from rpg.plasticine.numba_backend.compiling import Array, device
from rpg.plasticine.physics import SHAPES, Tool

TOOL = 5
SHAPE, FRICTION, SIZE = 0, 1, 2
_NUMBER = {name: number for number, name in enumerate(SHAPES)}
_SPHERE, _CAPSULE, _BOX = _NUMBER["sphere"], _NUMBER["capsule"], _NUMBER["box"]
_TORUS, _CHOPSTICKS = _NUMBER["torus"], _NUMBER["chopsticks"]
# Added to squared lengths, so that a centre or an axis has a distance but no normal.
_TINY = 1e-24

Vec3 = tuple[float, float, float]
# Symmetric: xx, xy, xz, yy, yz, zz.
Vec6 = tuple[float, float, float, float, float, float]


def describe(tool: Tool) -> list[float]:
    """A tool's row."""
    size = [*tool.size, 0.0, 0.0][:3]
    return [float(_NUMBER[tool.shape]), tool.friction, *size]


@device
def half_extent(tools: Array, at: int, gap: float) -> tuple[Vec3, Vec3]:
    """Centre and half size of a box around the shape, in its own frame."""
    shape, a, b, c = (tools[at + SHAPE], tools[at + SIZE], tools[at + SIZE + 1], tools[at + SIZE + 2])
    if shape == _SPHERE:
        return (0.0, 0.0, 0.0), (a, a, a)
    if shape == _CAPSULE:
        return (0.0, 0.0, 0.0), (b, 0.5 * a + b, b)
    if shape == _BOX:
        return (0.0, 0.0, 0.0), (a, b, c)
    if shape == _TORUS:
        return (0.0, 0.0, 0.0), (a + b, b, a + b)
    if shape == _CHOPSTICKS:
        return (0.0, -0.5 * a, 0.0), (0.5 * abs(gap) + b, 0.5 * a + b, b)
    return (0.0, 0.0, 0.0), (a, b, a)


@device
def _beyond(x: float, half: float) -> float:
    """How far x lies outside -half .. half, with sign."""
    if x > half:
        return x - half
    if x < -half:
        return x + half
    return 0.0


@device
def _offset(tools: Array, at: int, gap: float, q: Vec3) -> tuple[Vec3, float, float]:
    """For spheres, capsules, chopsticks: from the skeleton's nearest point to q, the radius, and dq_x / dgap."""
    shape, a, b = tools[at + SHAPE], tools[at + SIZE], tools[at + SIZE + 1]
    x, y, z = q
    if shape == _SPHERE:
        return (x, y, z), a, 0.0
    if shape == _CAPSULE:
        return (x, _beyond(y, 0.5 * a), z), b, 0.0
    # The nearer stick has its axis on the side of q.
    side = 0.5 if x < 0.0 else -0.5
    return (x + side * gap, _beyond(y + 0.5 * a, 0.5 * a), z), b, side


@device
def _sign(x: float) -> float:
    return -1.0 if x < 0.0 else 1.0


@device
def _one_if(condition: bool) -> float:
    return 1.0 if condition else 0.0


@device
def _box(tools: Array, at: int, q: Vec3) -> tuple[float, Vec3, Vec6]:
    hx, hy, hz = tools[at + SIZE], tools[at + SIZE + 1], tools[at + SIZE + 2]
    x, y, z = _beyond(q[0], hx), _beyond(q[1], hy), _beyond(q[2], hz)
    if x != 0.0 or y != 0.0 or z != 0.0:
        length = sqrt(x * x + y * y + z * z)
        moves = (_one_if(x != 0.0), _one_if(y != 0.0), _one_if(z != 0.0))
        return (length, (x / length, y / length, z / length), _bent((x, y, z), length, moves))
    dx, dy, dz = abs(q[0]) - hx, abs(q[1]) - hy, abs(q[2]) - hz
    flat = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if dx >= dy and dx >= dz:
        return dx, (_sign(q[0]), 0.0, 0.0), flat
    if dy >= dz:
        return dy, (0.0, _sign(q[1]), 0.0), flat
    return dz, (0.0, 0.0, _sign(q[2])), flat


@device
def _bent(offset: Vec3, length: float, moves: Vec3) -> Vec6:
    """Second derivative of the length of an offset, whose component i changes with q_i where ``moves[i]`` is 1."""
    nx, ny, nz = offset[0] / length, offset[1] / length, offset[2] / length
    x, y, z = moves
    return (
        (x - x * nx * nx) / length,
        -x * y * nx * ny / length,
        -x * z * nx * nz / length,
        (y - y * ny * ny) / length,
        -y * z * ny * nz / length,
        (z - z * nz * nz) / length,
    )


@device
def _meridian(tools: Array, at: int, rho: float, y: float) -> tuple[float, float, float, float, float, float]:
    """For cylinders and tori, in the half plane (rho, y): distance, normal (2) and its derivative (3)."""
    a, b = tools[at + SIZE], tools[at + SIZE + 1]
    if tools[at + SHAPE] == _TORUS:
        u, v, radius, p, q = rho - a, y, b, 1.0, 1.0
    else:
        u, v, radius = max(rho - a, 0.0), _beyond(y, b), 0.0
        # A component that is cut to zero has no derivative.
        p, q = _one_if(u != 0.0), _one_if(v != 0.0)
        if u == 0.0 and v == 0.0:
            if rho - a >= abs(y) - b:
                return rho - a, 1.0, 0.0, 0.0, 0.0, 0.0
            return abs(y) - b, 0.0, _sign(y), 0.0, 0.0, 0.0
    length = sqrt(u * u + v * v + _TINY)
    n, m = u / length, v / length
    return (length - radius, n, m, (p - n * n) / length, -n * m * p * q / length, (q - m * m) / length)


@device
def surface(tools: Array, at: int, gap: float, q: Vec3) -> tuple[float, Vec3, Vec6, float]:
    """Signed distance of q, its gradient (the outward normal), its second derivative, and dq_x / dgap.

    Chopsticks' distance depends on the gap as if q were shifted along x by the last result times the gap.
    """
    shape = tools[at + SHAPE]
    if shape == _BOX:
        d, normal, bend = _box(tools, at, q)
        return d, normal, bend, 0.0
    if shape in (_SPHERE, _CAPSULE, _CHOPSTICKS):
        offset, radius, side = _offset(tools, at, gap, q)
        x, y, z = offset[0], offset[1], offset[2]
        length = sqrt(x * x + y * y + z * z + _TINY)
        moves = (1.0, _one_if(shape == _SPHERE or y != 0.0), 1.0)
        return (length - radius, (x / length, y / length, z / length), _bent(offset, length, moves), side)
    x, y, z = q
    rho = sqrt(x * x + z * z + _TINY)
    ex, ez = x / rho, z / rho
    d, n, m, hnn, hnm, hmm = _meridian(tools, at, rho, y)
    round_ = n / rho
    bend = (
        hnn * ex * ex + round_ * (1.0 - ex * ex),
        hnm * ex,
        (hnn - round_) * ex * ez,
        hmm,
        hnm * ez,
        hnn * ez * ez + round_ * (1.0 - ez * ez),
    )
    return d, (n * ex, m, n * ez), bend, 0.0
