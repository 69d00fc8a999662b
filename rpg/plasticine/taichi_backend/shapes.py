"""Signed distance, outward normal, and curvature (second derivative of the distance) of every shape of a tool.

All at a point of the tool's own frame. The adjoint of a contact needs the curvature, since the normal turns when the
tool moves against the node. Lengths are smoothed by 1e-7, so that axes and centres have finite derivatives.
"""

from rpg.plasticine.physics import SHAPES
from rpg.plasticine.taichi_backend.types import Static, Value, func
from rpg.plasticine.taichi_module import ti

KINDS: dict[str, int] = {shape: number for number, shape in enumerate(SHAPES)}

_SPHERE, _CAPSULE, _BOX = KINDS["sphere"], KINDS["capsule"], KINDS["box"]
_CYLINDER, _TORUS = KINDS["cylinder"], KINDS["torus"]


@func
def smooth_length(vector: Value, real: Static) -> Value:
    """Length of a vector, never zero."""
    return ti.sqrt(vector.dot(vector) + real(1e-14))


@func
def diagonal(vector: Value) -> Value:
    """The diagonal matrix with these entries."""
    zero = 0.0 * vector[0]
    return ti.Matrix([[vector[0], zero, zero], [zero, vector[1], zero], [zero, zero, vector[2]]])


@func
def from_core(offset: Value, free: Value, real: Static) -> Value:
    """Length, direction and curvature of the offset from a core, constant where free is 0."""
    length = smooth_length(offset, real)
    normal = offset / length
    return length, normal, (diagonal(free) - normal.outer_product(normal)) / length


@func
def capsule(y: Value, low: Value, high: Value, radius: Value, real: Static) -> Value:
    """A segment along y between two heights, thickened by a radius; a sphere where both are zero."""
    offset, free = y, ti.Vector.one(real, 3)
    offset[1] = y[1] - ti.min(ti.max(y[1], low), high)
    if offset[1] == 0.0 and low < high:
        free[1] = 0.0
    length, normal, curvature = from_core(offset, free, real)
    return length - radius, normal, curvature


@func
def box(y: Value, half: Value, real: Static) -> Value:
    """A box of these half sizes."""
    outside, free = ti.Vector.zero(real, 3), ti.Vector.zero(real, 3)
    nearest = real(-1e30)
    face = ti.Vector.zero(real, 3)
    for i in ti.static(range(3)):
        sign = ti.select(y[i] < 0.0, real(-1.0), real(1.0))
        excess = ti.abs(y[i]) - half[i]
        if excess > 0.0:
            outside[i], free[i] = sign * excess, 1.0
        if excess > nearest:
            nearest = excess
            face = ti.Vector.zero(real, 3)
            face[i] = sign
    distance, normal, curvature = nearest, face, ti.Matrix.zero(real, 3, 3)
    if nearest > 0.0:
        distance, normal, curvature = from_core(outside, free, real)
    return distance, normal, curvature


@func
def revolved(y: Value, real: Static) -> Value:
    """Distance from the y axis and the direction away from it."""
    flat = ti.Vector([y[0], 0.0 * y[1], y[2]])
    rho = smooth_length(flat, real)
    return rho, flat / rho


@func
def revolved_normal(n_rho: Value, n_y: Value, rho: Value, radial: Value, bend: Value, real: Static) -> Value:
    """Normal and curvature of a surface of revolution from those of its section: (n_rho, n_y) and bend."""
    axis = ti.Vector.unit(3, 1, real)
    normal, tangent = n_rho * radial + n_y * axis, n_rho * axis - n_y * radial
    around = diagonal(1.0 - axis) - radial.outer_product(radial)
    return normal, around * (n_rho / rho) + tangent.outer_product(tangent) * bend


@func
def cylinder(y: Value, radius: Value, half_height: Value, real: Static) -> Value:
    """A solid cylinder around the y axis."""
    rho, radial = revolved(y, real)
    sign = ti.select(y[1] < 0.0, real(-1.0), real(1.0))
    beside, above = rho - radius, ti.abs(y[1]) - half_height
    distance = ti.max(beside, above)
    n_rho, n_y, bend = real(0.0), real(0.0), real(0.0)
    if beside > 0.0 and above > 0.0:  # nearest to the rim
        distance = ti.sqrt(beside * beside + above * above)
        n_rho, n_y, bend = beside / distance, sign * above / distance, 1.0 / distance
    elif beside > above:
        n_rho = 1.0
    else:
        n_y = sign
    normal, curvature = revolved_normal(n_rho, n_y, rho, radial, bend, real)
    return distance, normal, curvature


@func
def torus(y: Value, major: Value, minor: Value, real: Static) -> Value:
    """A torus around the y axis."""
    rho, radial = revolved(y, real)
    section = ti.Vector([rho - major, y[1]])
    length = smooth_length(section, real)
    normal, curvature = revolved_normal(
        section[0] / length, section[1] / length, rho, radial, 1.0 / length, real
    )
    return length - minor, normal, curvature


@func
def of_shape(shape: Static, y: Value, size: Value, gap: Value, real: Static) -> Value:
    """`signed_distance` of a shape that is known when the kernel is compiled."""
    zero, side = real(0.0), real(0.0)
    distance, normal, curvature = zero, ti.Vector.zero(real, 3), ti.Matrix.zero(real, 3, 3)
    if ti.static(shape == _SPHERE):
        distance, normal, curvature = capsule(y, zero, zero, size[0], real)
    elif ti.static(shape == _CAPSULE):
        distance, normal, curvature = capsule(y, -0.5 * size[0], 0.5 * size[0], size[1], real)
    elif ti.static(shape == _BOX):
        distance, normal, curvature = box(y, size, real)
    elif ti.static(shape == _CYLINDER):
        distance, normal, curvature = cylinder(y, size[0], size[1], real)
    elif ti.static(shape == _TORUS):
        distance, normal, curvature = torus(y, size[0], size[1], real)
    else:
        side = ti.select(y[0] < 0.0, real(-1.0), real(1.0))
        beside = y
        beside[0] -= 0.5 * side * gap
        distance, normal, curvature = capsule(beside, -size[0], zero, size[1], real)
    return distance, normal, curvature, side


@func
def signed_distance(kind: Value, y: Value, size: Value, gap: Value, present: Static, real: Static) -> Value:
    """Distance, normal and curvature of a tool of this kind, compiled for the kinds present.

    The fourth result says on which of two chopsticks the nearest point is, -1 or 1, else 0: the derivative of the
    distance with respect to the gap is minus half of it times the normal's x component.
    """
    distance, normal = real(0.0), ti.Vector.zero(real, 3)
    curvature, side = ti.Matrix.zero(real, 3, 3), real(0.0)
    for shape in ti.static(present):
        if kind == shape:
            distance, normal, curvature, side = of_shape(shape, y, size, gap, real)
    return distance, normal, curvature, side
