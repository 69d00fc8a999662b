# mypy: allow-untyped-defs, allow-incomplete-defs
# (Taichi takes any annotation of a kernel's result, None too, for a value to return.)
"""What happens on the grid in a substep: momentum to velocity, gravity, tools, walls; and the adjoint.

Arrays, flat as in `rpg.plasticine.taichi_backend.stencil` unless a shape is given:

- ``grid``: what the particles scatter, momentum and mass, a copy in every lane; left empty for the next scatter.
- ``nodes``: the sum of the lanes; in the adjoint it becomes the adjoint of that.
- ``velocity``: the result, in the first three places of a node.
- ``motion`` (B, substeps, tools, 25), ``kinds`` (tools,), ``sizes`` (tools, 4) with the friction in the last place.
"""

from rpg.plasticine.taichi_backend.contact import slide, slide_adjoint, strength, walls, walls_adjoint
from rpg.plasticine.taichi_backend.shapes import signed_distance
from rpg.plasticine.taichi_backend.stencil import box_size
from rpg.plasticine.taichi_backend.types import Array, Float, Int, Real, Value, func, kernel
from rpg.plasticine.taichi_module import ti

_EMPTY = 1e-12  # mass of a node at and below which it has no velocity


@func
def frame(motion: Array, scene: Value, substep: Value, tool: Value) -> Value:
    """Origin and rotation of a tool at the beginning of a substep."""
    origin = ti.Vector([motion[scene, substep, tool, i] for i in ti.static(range(3))])
    rotation = ti.Matrix(
        [
            [motion[scene, substep, tool, 3 + 3 * i + j] for j in ti.static(range(3))]
            for i in ti.static(range(3))
        ]
    )
    return origin, rotation


@func
def velocity_field(motion: Array, scene: Value, substep: Value, tool: Value) -> Value:
    """Linear velocity and spin of a tool during a substep."""
    linear = ti.Vector([motion[scene, substep, tool, 12 + i] for i in ti.static(range(3))])
    spin = ti.Matrix(
        [
            [motion[scene, substep, tool, 15 + 3 * i + j] for j in ti.static(range(3))]
            for i in ti.static(range(3))
        ]
    )
    return linear, spin


@ti.data_oriented
class GridKernels:
    """Kernels for one dtype, one set of constants, and the tools' kinds.

    Args:
        real: ti.f32 or ti.f64.
        nodes: nodes per unit length.
        dt: seconds of a substep.
        gravity: acceleration.
        friction: of the floor.
        kinds: numbers of the shapes of all tools, in their order (`shapes.KINDS`).
    """

    def __init__(
        self,
        real: Real,
        nodes: int,
        dt: float,
        gravity: tuple[float, float, float],
        friction: float,
        kinds: tuple[int, ...],
    ) -> None:
        self.real, self.nodes, self.friction = real, nodes, friction
        self.dx = 1.0 / nodes
        self.fall = tuple(dt * g for g in gravity)
        self.tools, self.present = len(kinds), tuple(sorted(set(kinds)))

    @func
    def contact(
        self,
        v: Value,
        position: Value,
        motion: Array,
        kinds: Array,
        sizes: Array,
        scene: Value,
        substep: Value,
        tool: Value,
        softness: Value,
    ) -> Value:
        """Velocity of a node after one tool."""
        result = v
        origin, rotation = frame(motion, scene, substep, tool)
        arm = position - origin
        size = ti.Vector([sizes[tool, i] for i in ti.static(range(3))])
        distance, normal, _, _ = signed_distance(
            kinds[tool],
            rotation.transpose() @ arm,
            size,
            motion[scene, substep, tool, 24],
            self.present,
            self.real,
        )
        share = strength(distance, softness, self.real)
        if share > 0.0:
            linear, spin = velocity_field(motion, scene, substep, tool)
            tool_velocity = linear + spin @ arm
            relative = v - tool_velocity
            slid = slide(relative, rotation @ normal, sizes[tool, 3], self.real)
            result = tool_velocity + (1.0 - share) * relative + share * slid
        return result

    @func
    def contact_adjoint(
        self,
        v: Value,
        position: Value,
        motion: Array,
        kinds: Array,
        sizes: Array,
        scene: Value,
        substep: Value,
        tool: Value,
        softness: Value,
        adjoint: Value,
        motion_adjoint: Array,
    ) -> Value:
        """Adjoint of a node's velocity before one tool, given that after it; adds that of the tool's motion."""
        result = adjoint
        origin, rotation = frame(motion, scene, substep, tool)
        arm = position - origin
        size = ti.Vector([sizes[tool, i] for i in ti.static(range(3))])
        distance, normal, curvature, side = signed_distance(
            kinds[tool],
            rotation.transpose() @ arm,
            size,
            motion[scene, substep, tool, 24],
            self.present,
            self.real,
        )
        share = strength(distance, softness, self.real)
        if share > 0.0:
            linear, spin = velocity_field(motion, scene, substep, tool)
            relative = v - linear - spin @ arm
            turned = rotation @ normal
            slid = slide(relative, turned, sizes[tool, 3], self.real)
            through, through_normal = slide_adjoint(
                relative, turned, sizes[tool, 3], share * adjoint, self.real
            )
            result = through + (1.0 - share) * adjoint
            through_distance = self.real(0.0)
            if distance > 0.0:
                through_distance = -softness * share * adjoint.dot(slid - relative)
            local = rotation.transpose() @ through_normal
            through_local = curvature @ local + through_distance * normal
            through_tool = adjoint - result
            through_arm = rotation @ through_local + spin.transpose() @ through_tool
            for i in ti.static(range(3)):
                motion_adjoint[scene, substep, tool, i] -= through_arm[i]
                motion_adjoint[scene, substep, tool, 12 + i] += through_tool[i]
                for j in ti.static(range(3)):
                    turn = through_normal[i] * normal[j] + arm[i] * through_local[j]
                    motion_adjoint[scene, substep, tool, 3 + 3 * i + j] += turn
                    motion_adjoint[scene, substep, tool, 15 + 3 * i + j] += through_tool[i] * arm[j]
            motion_adjoint[scene, substep, tool, 24] -= 0.5 * side * through_local[0]
        return result

    @func
    def free_velocity(self, total: Value) -> Value:
        """Velocity before tools and walls of a node with this momentum and mass."""
        return ti.Vector([total[i] / total[3] + self.real(self.fall[i]) for i in ti.static(range(3))])

    @func
    def node(self, window: Array, number: Value) -> Value:
        """Scene and index in the grid of a node that has this number in memory."""
        size = box_size(window, 0)
        k, row = number % size[2], number // size[2]
        j, sheet = row % size[1], row // size[1]
        scene = sheet // size[0]
        offset = ti.Vector([sheet % size[0], j, k])
        return scene, ti.Vector([window[scene, i] for i in ti.static(range(3))]) + offset

    @func
    def collect(self, grid: Array, at: Value, count: Value) -> Value:
        """Four numbers of a node, summed over the lanes of so many numbers each, which are emptied."""
        result = ti.Vector.zero(self.real, 4)
        for lane in range(grid.shape[0] // count):
            for n in ti.static(range(4)):
                result[n] += grid[lane * count + at + n]
                grid[lane * count + at + n] = 0.0
        return result

    @kernel
    def update(
        self,
        grid: Array,
        nodes: Array,
        velocity: Array,
        window: Array,
        motion: Array,
        kinds: Array,
        sizes: Array,
        softness: Float,
        substep: Int,
    ):
        """Sum the lanes and find every node's velocity."""
        for number in range(nodes.shape[0] // 4):
            at = 4 * number
            total = self.collect(grid, at, nodes.shape[0])
            for n in ti.static(range(4)):
                nodes[at + n] = total[n]
            v = ti.Vector.zero(self.real, 3)
            if not total[3] <= self.real(_EMPTY):  # a mass that is not a number must show
                scene, index = self.node(window, number)
                position = index * self.real(self.dx)
                alpha = ti.cast(softness, self.real)
                v = self.free_velocity(total)
                for tool in range(self.tools):
                    v = self.contact(v, position, motion, kinds, sizes, scene, substep, tool, alpha)
                v = walls(v, index, self.nodes, self.friction, self.real)
            for n in ti.static(range(3)):
                velocity[at + n] = v[n]

    @kernel
    def update_adjoint(
        self,
        grid: Array,
        nodes: Array,
        window: Array,
        motion: Array,
        motion_adjoint: Array,
        kinds: Array,
        sizes: Array,
        softness: Float,
        substep: Int,
    ):
        """From the adjoint of the velocity in ``grid`` to that of momentum and mass in ``nodes``."""
        for number in range(nodes.shape[0] // 4):
            at = 4 * number
            given = self.collect(grid, at, nodes.shape[0])
            total = ti.Vector([nodes[at + n] for n in ti.static(range(4))])
            result = ti.Vector.zero(self.real, 4)
            if not total[3] <= self.real(_EMPTY):
                scene, index = self.node(window, number)
                position = index * self.real(self.dx)
                alpha = ti.cast(softness, self.real)
                v = self.free_velocity(total)
                before = ti.Matrix.zero(self.real, ti.static(max(self.tools, 1)), 3)
                for tool in range(self.tools):
                    for n in ti.static(range(3)):
                        before[tool, n] = v[n]
                    v = self.contact(v, position, motion, kinds, sizes, scene, substep, tool, alpha)
                adjoint = ti.Vector([given[n] for n in ti.static(range(3))])
                adjoint = walls_adjoint(v, index, adjoint, self.nodes, self.friction, self.real)
                for reverse in range(self.tools):
                    tool = self.tools - 1 - reverse
                    entering = ti.Vector([before[tool, n] for n in ti.static(range(3))])
                    adjoint = self.contact_adjoint(
                        entering,
                        position,
                        motion,
                        kinds,
                        sizes,
                        scene,
                        substep,
                        tool,
                        alpha,
                        adjoint,
                        motion_adjoint,
                    )
                for n in ti.static(range(3)):
                    result[n] = adjoint[n] / total[3]
                    result[3] -= result[n] * total[n] / total[3]
            for n in ti.static(range(4)):
                nodes[at + n] = result[n]
