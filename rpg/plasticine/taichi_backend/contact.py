"""What changes the velocity of one grid node: a tool that touches it, the floor, the walls; and the adjoints.

Written out by hand. Taichi's reverse mode would differentiate a whole kernel at a time, and could not reuse the second
derivative of the distance that `rpg.plasticine.taichi_backend.shapes` has in closed form.
"""

from rpg.plasticine.taichi_backend.types import Static, Value, func
from rpg.plasticine.taichi_module import ti

_STICKY = 10.0  # floor friction from which everything sticks
_TINY = 1e-30  # keeps the floor's friction finite where nothing slides
_WALL = 3  # nodes from a face of the domain inside which it acts


@func
def strength(distance: Value, softness: Value, real: Static) -> Value:
    """How strongly a tool acts on a node at this distance: 1 inside, ``exp(-softness distance)`` while above 0.1."""
    result = real(0.0)
    if distance <= 0.0:
        result = 1.0
    elif softness > 0.0:
        result = ti.exp(-softness * distance)
        if result <= real(0.1):
            result = 0.0
    return result


@func
def slide(relative: Value, normal: Value, friction: Value, real: Static) -> Value:
    """Relative velocity after the contact: what approaches is removed, and Coulomb friction acts on the rest."""
    result = relative
    approach = relative.dot(normal)
    if approach < 0.0:
        tangential = relative - approach * normal
        speed = ti.sqrt(tangential.dot(tangential) + real(1e-8))
        result = tangential * (ti.max(0.0, speed + friction * approach) / speed)
    return result


@func
def slide_adjoint(relative: Value, normal: Value, friction: Value, adjoint: Value, real: Static) -> Value:
    """Adjoints of the relative velocity and of the normal, given that of `slide`."""
    through, through_normal = adjoint, ti.Vector.zero(real, 3)
    approach = relative.dot(normal)
    if approach < 0.0:
        tangential = relative - approach * normal
        speed = ti.sqrt(tangential.dot(tangential) + real(1e-8))
        scale = 1.0 + friction * approach / speed
        through_tangential, through_approach = ti.Vector.zero(real, 3), real(0.0)
        if scale > 0.0:
            through_scale = adjoint.dot(tangential)
            through_approach = through_scale * friction / speed
            through_tangential = scale * adjoint
            through_tangential -= tangential * (through_approach * approach / (speed * speed))
        through_approach -= through_tangential.dot(normal)
        through = through_tangential + through_approach * normal
        through_normal = through_approach * relative - approach * through_tangential
    return through, through_normal


@func
def walls(velocity: Value, index: Value, nodes: Static, friction: Static, real: Static) -> Value:
    """Velocity of a node after the walls and the floor, in the order x, y, z."""
    v = velocity
    for axis in ti.static(range(3)):
        if index[axis] < _WALL and v[axis] < 0.0:
            if ti.static(axis == 1):
                v = land(v, friction, real)
            v[axis] = 0.0
        if index[axis] > nodes - _WALL and v[axis] > 0.0:
            v[axis] = 0.0
    return v


@func
def land(v: Value, friction: Static, real: Static) -> Value:
    """What the floor leaves of the tangential velocity of a node that falls on it."""
    result = v
    if ti.static(friction >= _STICKY):
        result = ti.Vector.zero(real, 3)
    elif ti.static(friction > 0.0):
        speed = ti.sqrt(v[0] * v[0] + v[2] * v[2]) + real(_TINY)
        result = v * ti.max(0.0, 1.0 + real(friction) * v[1] / speed)
    return result


@func
def walls_adjoint(
    velocity: Value, index: Value, adjoint: Value, nodes: Static, friction: Static, real: Static
) -> Value:
    """Adjoint of the velocity before `walls`, given that after them: z is undone first, x last."""
    v, g = velocity, adjoint
    stopped = ti.Vector.zero(ti.i32, 3)
    for axis in ti.static(range(3)):
        if (index[axis] < _WALL and v[axis] < 0.0) or (index[axis] > nodes - _WALL and v[axis] > 0.0):
            stopped[axis] = 1
    if stopped[0] == 1:
        v[0] = 0.0  # as the floor saw it
    if stopped[2] == 1:
        g[2] = 0.0
    if stopped[1] == 1:
        g[1] = 0.0
        if index[1] < _WALL:
            g = land_adjoint(v, g, friction, real)
    if stopped[0] == 1:
        g[0] = 0.0
    return g


@func
def land_adjoint(v: Value, adjoint: Value, friction: Static, real: Static) -> Value:
    """Adjoint of the velocity with which a node falls on the floor, given that of its tangential velocity after."""
    result = adjoint
    if ti.static(friction > 0.0):
        result = ti.Vector.zero(real, 3)
    if ti.static(0.0 < friction < _STICKY):
        speed = ti.sqrt(v[0] * v[0] + v[2] * v[2]) + real(_TINY)
        scale = 1.0 + real(friction) * v[1] / speed
        if scale > 0.0:
            result[1] = (adjoint[0] * v[0] + adjoint[2] * v[2]) * real(friction) / speed
            shrink = result[1] * (v[1] / speed) / speed
            result[0] = scale * adjoint[0] - shrink * v[0]
            result[2] = scale * adjoint[2] - shrink * v[2]
    return result
