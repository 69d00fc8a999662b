"""Velocity of a node near a tool and at the walls (step 5 of `rpg.plasticine.backend`), and the adjoints."""

from __future__ import annotations

from math import exp, sqrt

from rpg.plasticine.numba_backend.compiling import Array, device
from rpg.plasticine.numba_backend.surface import FRICTION, Vec3, half_extent, surface

# Places in a tool's motion, see `rpg.plasticine.backend.MOTION`.
_ORIGIN, _ROTATION, _LINEAR, _SPIN, _GAP = 0, 3, 12, 15, 24
_WEAKEST = 0.1
_SOFTENING = 1e-8
_STICKS = 10.0
# Keeps the floor's friction finite where nothing slides.
_TINY = 1e-30


@device
def reach(tools: Array, at: int, motion: Array, m: int, softness: float) -> tuple[Vec3, Vec3]:
    """Lowest and highest corner of a box outside of which a tool has no effect."""
    centre, half = half_extent(tools, at, motion[m + _GAP])
    shell = 2.302585092994046 / softness if softness > 0.0 else 0.0
    x, ex = _bounds(motion, m, 0, centre, half)
    y, ey = _bounds(motion, m, 1, centre, half)
    z, ez = _bounds(motion, m, 2, centre, half)
    # A little more, against rounding.
    shell += 1e-6
    low = (x - ex - shell, y - ey - shell, z - ez - shell)
    high = (x + ex + shell, y + ey + shell, z + ez + shell)
    return low, high


@device
def _bounds(motion: Array, m: int, axis: int, centre: Vec3, half: Vec3) -> tuple[float, float]:
    r = m + _ROTATION + 3 * axis
    middle = motion[m + axis] + motion[r] * centre[0] + motion[r + 1] * centre[1] + motion[r + 2] * centre[2]
    return middle, abs(motion[r]) * half[0] + abs(motion[r + 1]) * half[1] + abs(motion[r + 2]) * half[2]


@device
def _rotated(motion: Array, m: int, v: Vec3) -> Vec3:
    r = m + _ROTATION
    return (
        motion[r] * v[0] + motion[r + 1] * v[1] + motion[r + 2] * v[2],
        motion[r + 3] * v[0] + motion[r + 4] * v[1] + motion[r + 5] * v[2],
        motion[r + 6] * v[0] + motion[r + 7] * v[1] + motion[r + 8] * v[2],
    )


@device
def _rotated_back(motion: Array, m: int, v: Vec3) -> Vec3:
    r = m + _ROTATION
    return (
        motion[r] * v[0] + motion[r + 3] * v[1] + motion[r + 6] * v[2],
        motion[r + 1] * v[0] + motion[r + 4] * v[1] + motion[r + 7] * v[2],
        motion[r + 2] * v[0] + motion[r + 5] * v[1] + motion[r + 8] * v[2],
    )


@device
def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device
def _plus(a: Vec3, k: float, b: Vec3) -> Vec3:
    """a + k b."""
    return a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]


@device
def _times(k: float, a: Vec3) -> Vec3:
    return k * a[0], k * a[1], k * a[2]


@device
def _tool_velocity(motion: Array, m: int, arm: Vec3) -> Vec3:
    s = m + _SPIN
    return (
        motion[m + _LINEAR] + motion[s] * arm[0] + motion[s + 1] * arm[1] + motion[s + 2] * arm[2],
        motion[m + _LINEAR + 1] + motion[s + 3] * arm[0] + motion[s + 4] * arm[1] + motion[s + 5] * arm[2],
        motion[m + _LINEAR + 2] + motion[s + 6] * arm[0] + motion[s + 7] * arm[1] + motion[s + 8] * arm[2],
    )


@device
def _strength(d: float, softness: float) -> float:
    """How much of the contact acts at a signed distance, 0 for none of it."""
    if d <= 0.0:
        return 1.0
    if softness <= 0.0:
        return 0.0
    s = exp(-softness * d)
    return s if s > _WEAKEST else 0.0


@device
def _projected(u: Vec3, normal: Vec3, friction: float) -> tuple[float, Vec3, float, float]:
    """Normal part of u, the tangential rest, its length, and what friction leaves of it (a factor)."""
    un = _dot(u, normal)
    if un >= 0.0:
        return un, u, 1.0, 1.0
    rest = _plus(u, -un, normal)
    length = sqrt(_dot(rest, rest) + _SOFTENING)
    return un, rest, length, max(0.0, 1.0 + friction * un / length)


@device
def touch(tools: Array, at: int, motion: Array, m: int, softness: float, node: Vec3, v: Vec3) -> Vec3:
    """Velocity of a node after a tool."""
    arm = _plus(node, -1.0, (motion[m], motion[m + 1], motion[m + 2]))
    d, n, _, _ = surface(tools, at, motion[m + _GAP], _rotated_back(motion, m, arm))
    s = _strength(d, softness)
    if s == 0.0:
        return v
    normal = _rotated(motion, m, n)
    field = _tool_velocity(motion, m, arm)
    u = _plus(v, -1.0, field)
    _, rest, _, kept = _projected(u, normal, tools[at + FRICTION])
    return _plus(_plus(field, 1.0 - s, u), s * kept, rest)


@device
def _projected_adjoint(u: Vec3, normal: Vec3, friction: float, g: Vec3) -> tuple[Vec3, Vec3]:
    """Adjoints of u and of the normal, given that of the tangential rest after friction."""
    un, rest, length, kept = _projected(u, normal, friction)
    if un >= 0.0:
        return g, (0.0, 0.0, 0.0)
    grest = _times(kept, g)
    gun = 0.0
    if kept > 0.0:
        gkept = _dot(g, rest)
        gun = gkept * friction / length
        grest = _plus(grest, -gkept * friction * un / (length * length * length), rest)
    gun -= _dot(grest, normal)
    return _plus(grest, gun, normal), _plus(_times(-un, grest), gun, u)


@device
def touch_adjoint(
    tools: Array,
    at: int,
    motion: Array,
    m: int,
    softness: float,
    node: Vec3,
    v: Vec3,
    g: Vec3,
    gmotion: Array,
    gm: int,
) -> Vec3:
    """Adjoint of a node's velocity before a tool, given that after it; adds that of the motion at ``gmotion[gm]``."""
    arm = _plus(node, -1.0, (motion[m], motion[m + 1], motion[m + 2]))
    q = _rotated_back(motion, m, arm)
    d, n, bend, side = surface(tools, at, motion[m + _GAP], q)
    s = _strength(d, softness)
    if s == 0.0:
        return g
    normal = _rotated(motion, m, n)
    u = _plus(v, -1.0, _tool_velocity(motion, m, arm))
    _, rest, _, kept = _projected(u, normal, tools[at + FRICTION])
    gu, gnormal = _projected_adjoint(u, normal, tools[at + FRICTION], _times(s, g))
    gu = _plus(gu, 1.0 - s, g)
    gd = 0.0
    if d > 0.0:
        gd = -softness * s * (kept * _dot(g, rest) - _dot(g, u))
    # Through the signed distance and the normal to q = R^T arm and to R.
    gn = _rotated_back(motion, m, gnormal)
    gq = (
        gd * n[0] + bend[0] * gn[0] + bend[1] * gn[1] + bend[2] * gn[2],
        gd * n[1] + bend[1] * gn[0] + bend[3] * gn[1] + bend[4] * gn[2],
        gd * n[2] + bend[2] * gn[0] + bend[4] * gn[1] + bend[5] * gn[2],
    )
    _add_motion(motion, m, arm, n, gnormal, gq, _plus(g, -1.0, gu), gmotion, gm)
    gmotion[gm + _GAP] += side * gq[0]
    return gu


@device
def _add_motion(
    motion: Array, m: int, arm: Vec3, n: Vec3, gnormal: Vec3, gq: Vec3, gfield: Vec3, gmotion: Array, gm: int
) -> None:
    """Add the adjoints of origin, rotation, linear and spin."""
    garm = _rotated(motion, m, gq)
    for i in range(3):
        gmotion[gm + _LINEAR + i] += gfield[i]
        back = garm[i]
        for j in range(3):
            back += motion[m + _SPIN + 3 * j + i] * gfield[j]
            gmotion[gm + _SPIN + 3 * i + j] += gfield[i] * arm[j]
            gmotion[gm + _ROTATION + 3 * i + j] += gnormal[i] * n[j] + arm[i] * gq[j]
        gmotion[gm + _ORIGIN + i] -= back


@device
def _stopped(i: int, v: float, grid: int) -> bool:
    """Whether a wall takes a component of the velocity."""
    return (i < 3 and v < 0.0) or (i > grid - 3 and v > 0.0)


@device
def _slide(x: float, y: float, z: float, friction: float) -> tuple[float, float]:
    """What the floor's friction leaves of the tangential velocity (a factor), and its length."""
    length = sqrt(x * x + z * z) + _TINY
    return max(0.0, 1.0 + friction * y / length), length


@device
def wall(i: int, j: int, k: int, grid: int, friction: float, v: Vec3) -> Vec3:
    """Velocity of node i, j, k after the walls."""
    x, y, z = v
    if _stopped(i, x, grid):
        x = 0.0
    if j < 3 and y < 0.0:
        if friction >= _STICKS:
            return 0.0, 0.0, 0.0
        kept, _ = _slide(x, y, z, friction)
        x, y, z = kept * x, 0.0, kept * z
    elif _stopped(j, y, grid):
        y = 0.0
    if _stopped(k, z, grid):
        z = 0.0
    return x, y, z


@device
def wall_adjoint(i: int, j: int, k: int, grid: int, friction: float, v: Vec3, g: Vec3) -> Vec3:
    """Adjoint of the velocity before the walls, given that after them."""
    x, y, z = v
    gx, gy, gz = g
    stop_x = _stopped(i, x, grid)
    if stop_x:
        x = 0.0
    # The factor of the floor is never negative: z keeps its sign for its own wall.
    if _stopped(k, z, grid):
        gz = 0.0
    if j < 3 and y < 0.0:
        if friction >= _STICKS:
            return 0.0, 0.0, 0.0
        kept, length = _slide(x, y, z, friction)
        along = gx * x + gz * z
        gx, gy, gz = kept * gx, 0.0, kept * gz
        if kept > 0.0:
            gy = along * friction / length
            turn = -along * friction * y / (length * length * length)
            gx, gz = gx + turn * x, gz + turn * z
    elif _stopped(j, y, grid):
        gy = 0.0
    if stop_x:
        gx = 0.0
    return gx, gy, gz
