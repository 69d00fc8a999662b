# mypy: allow-untyped-defs, allow-incomplete-defs
# (Taichi takes any annotation of a kernel's result, None too, for a value to return.)
"""What happens on the particles in a substep: material and scatter to the grid, gather and motion; and the adjoints.

Arrays, with B scenes of N particles: ``x``, ``v`` (B, N, 3), ``C`` (B, N, 3, 3), ``b`` (B, N, 6), ``material``
(B, N, 3); those of nodes are described in `rpg.plasticine.taichi_backend.stencil`. All scenes are in one launch.

The loop of a scatter runs over workers. On a CPU there are as many a scene as the grid has lanes, each adds a range of
particles to its own lane, and nothing is atomic. On a GPU every particle is a worker, and all add to one lane.
"""

from rpg.plasticine.taichi_backend.material import flow, update, update_adjoint
from rpg.plasticine.taichi_backend.stencil import (
    matrix,
    node_vector,
    place,
    spline,
    stencil,
    store,
    store_matrix,
    vector,
    weight_and_slope,
)
from rpg.plasticine.taichi_backend.tensors import eigen, pack, pack_adjoint, unpack, unpack_adjoint
from rpg.plasticine.taichi_backend.types import Array, Int, Real, Value, func, kernel
from rpg.plasticine.taichi_module import ti


@ti.data_oriented
class ParticleKernels:
    """Kernels for one dtype and one set of constants, shared by all scenes that have these.

    Args:
        real: ti.f32 or ti.f64.
        nodes: nodes per unit length.
        dt: seconds of a substep.
        sweeps: of the eigenproblem.
        private: whether a lane of the grid belongs to one worker; else adding to it is atomic.
    """

    def __init__(self, real: Real, nodes: int, dt: float, sweeps: int, private: bool) -> None:
        self.real, self.nodes, self.sweeps, self.private = real, nodes, sweeps, private
        self.dt, self.dx = dt, 1.0 / nodes
        self.highest = 1.0 - 3.0 / nodes  # coordinate at which positions are clamped
        self.apic = 4.0 * nodes * nodes  # inverse of the splines' inertia

    @func
    def add(self, grid: Array, at: Value, value: Value) -> None:
        """Add to one number of a node."""
        if ti.static(self.private):
            grid[at] = grid[at] + value
        else:
            grid[at] += value

    @func
    def lane(self, worker: Value, size: Value, scenes: Value) -> Value:
        """The first node of a worker's lane; on a GPU there is one lane."""
        result = 0
        if ti.static(self.private):
            result = worker * scenes * size[0] * size[1] * size[2]
        return result

    @kernel
    def scatter(
        self,
        x: Array,
        v: Array,
        C: Array,
        b: Array,
        material: Array,
        mass: Array,
        volume: Array,
        b_after: Array,
        grid: Array,
        window: Array,
        escaped: Array,
        workers: Int,
    ):
        """Advance b and add mass and momentum to the grid."""
        for number in range(x.shape[0] * workers):
            scene, worker = number // workers, number % workers
            share = (x.shape[1] + workers - 1) // workers
            for p in range(worker * share, ti.min(x.shape[1], (worker + 1) * share)):
                affine = matrix(C, scene, p)
                step = ti.Matrix.identity(self.real, 3) + self.real(self.dt) * affine
                trial = step @ unpack(vector(b, scene, p, 6)) @ step.transpose()
                values, vectors = eigen(trial, self.sweeps, self.real)
                elastic = vector(material, scene, p, 3)
                _, _, norm, limit, roots = flow(values, elastic[0], elastic[2], self.real)
                returned, stress = update(trial, values, vectors, roots, norm > limit, elastic[0], elastic[1])
                store(b_after, scene, p, pack(returned), 6)
                impulse = mass[p] * affine - self.real(self.dt * self.apic) * volume[p] * stress
                impulse *= self.real(self.dx)  # of a lever in cells
                momentum = mass[p] * vector(v, scene, p, 3)
                first, f, size, outside = stencil(vector(x, scene, p, 3) * self.nodes, window, scene)
                if outside == 1:
                    escaped[0] = 1
                first += self.lane(worker, size, x.shape[0])
                for i in range(3):
                    for j in range(3):
                        row, weight_row = place(first, size, i, j, 0), spline(f[0], i) * spline(f[1], j)
                        for k in ti.static(range(3)):
                            weight = weight_row * spline(f[2], k)
                            value = weight * (momentum + impulse @ (ti.Vector([i, j, k]) - f))
                            for n in ti.static(range(3)):
                                self.add(grid, row + 4 * k + n, value[n])
                            self.add(grid, row + 4 * k + 3, weight * mass[p])

    @kernel
    def gather(
        self, x: Array, velocity: Array, window: Array, x_after: Array, v_after: Array, C_after: Array
    ):
        """Velocity and affine field from the grid, and the new position."""
        for scene, p in ti.ndrange(x.shape[0], x.shape[1]):
            position = vector(x, scene, p, 3)
            first, f, size, _ = stencil(position * self.nodes, window, scene)
            linear, affine = ti.Vector.zero(self.real, 3), ti.Matrix.zero(self.real, 3, 3)
            for i in range(3):
                for j in range(3):
                    row, weight_row = place(first, size, i, j, 0), spline(f[0], i) * spline(f[1], j)
                    for k in ti.static(range(3)):
                        share = weight_row * spline(f[2], k) * node_vector(velocity, row + 4 * k)
                        linear += share
                        affine += share.outer_product(ti.Vector([i, j, k]) - f)
            store(v_after, scene, p, linear, 3)
            store_matrix(C_after, scene, p, affine * self.real(self.apic * self.dx))
            moved = position + self.real(self.dt) * linear
            for i in ti.static(range(3)):
                if moved[i] < 0.0:
                    moved[i] = 0.0
                if moved[i] > self.real(self.highest):
                    moved[i] = self.real(self.highest)
            store(x_after, scene, p, moved, 3)

    @kernel
    def gather_adjoint(
        self,
        x: Array,
        v_after: Array,
        velocity: Array,
        grid: Array,
        window: Array,
        x_adjoint: Array,
        v_adjoint: Array,
        C_adjoint: Array,
        workers: Int,
    ):
        """Add the adjoint of the nodes' velocity to the grid; that of x becomes what `gather` alone contributes."""
        for number in range(x.shape[0] * workers):
            scene, worker = number // workers, number % workers
            share = (x.shape[1] + workers - 1) // workers
            for p in range(worker * share, ti.min(x.shape[1], (worker + 1) * share)):
                position = vector(x, scene, p, 3)
                moved = position + self.real(self.dt) * vector(v_after, scene, p, 3)
                through_x = vector(x_adjoint, scene, p, 3)
                for i in ti.static(range(3)):
                    if moved[i] < 0.0 or moved[i] > self.real(self.highest):
                        through_x[i] = 0.0
                through_v = vector(v_adjoint, scene, p, 3) + self.real(self.dt) * through_x
                through_C = matrix(C_adjoint, scene, p) * self.real(
                    self.apic * self.dx
                )  # of a lever in cells
                first, f, size, _ = stencil(position * self.nodes, window, scene)
                lane = 4 * self.lane(worker, size, x.shape[0])
                slope, lever = ti.Vector.zero(self.real, 3), ti.Vector.zero(self.real, 3)
                for i in range(3):
                    for j in range(3):
                        row = place(first, size, i, j, 0)
                        for k in ti.static(range(3)):
                            weight, gradient = weight_and_slope(f, i, j, k)
                            value = through_v + through_C @ (ti.Vector([i, j, k]) - f)
                            at_node = node_vector(velocity, row + 4 * k)
                            slope += gradient * at_node.dot(value)
                            lever += weight * at_node
                            for n in ti.static(range(3)):
                                self.add(grid, lane + row + 4 * k + n, weight * value[n])
                through_x += self.nodes * (slope - through_C.transpose() @ lever)
                store(x_adjoint, scene, p, through_x, 3)

    @kernel
    def scatter_adjoint(
        self,
        x: Array,
        v: Array,
        C: Array,
        b: Array,
        material: Array,
        mass: Array,
        volume: Array,
        nodes: Array,
        window: Array,
        x_adjoint: Array,
        v_adjoint: Array,
        C_adjoint: Array,
        b_adjoint: Array,
        material_adjoint: Array,
    ):
        """Adjoints of the substep's input from those of the nodes' momentum and mass and of b."""
        for scene, p in ti.ndrange(x.shape[0], x.shape[1]):
            affine = matrix(C, scene, p)
            step = ti.Matrix.identity(self.real, 3) + self.real(self.dt) * affine
            before = unpack(vector(b, scene, p, 6))
            trial = step @ before @ step.transpose()
            values, vectors = eigen(trial, self.sweeps, self.real)
            elastic = vector(material, scene, p, 3)
            stretch, deviator, norm, limit, roots = flow(values, elastic[0], elastic[2], self.real)
            _, stress = update(trial, values, vectors, roots, norm > limit, elastic[0], elastic[1])
            factor = self.real(self.dt * self.apic) * volume[p]
            impulse = (mass[p] * affine - factor * stress) * self.real(self.dx)  # of a lever in cells
            momentum = mass[p] * vector(v, scene, p, 3)
            first, f, size, _ = stencil(vector(x, scene, p, 3) * self.nodes, window, scene)
            through_momentum, slope = ti.Vector.zero(self.real, 3), ti.Vector.zero(self.real, 3)
            through_impulse = ti.Matrix.zero(self.real, 3, 3)
            for i in range(3):
                for j in range(3):
                    row = place(first, size, i, j, 0)
                    for k in ti.static(range(3)):
                        weight, gradient = weight_and_slope(f, i, j, k)
                        arm = ti.Vector([i, j, k]) - f
                        at_node = node_vector(nodes, row + 4 * k)
                        slope += gradient * (
                            at_node.dot(momentum + impulse @ arm) + nodes[row + 4 * k + 3] * mass[p]
                        )
                        through_momentum += weight * at_node
                        through_impulse += (weight * at_node).outer_product(arm)
            through_x = vector(x_adjoint, scene, p, 3)
            through_x += self.nodes * (slope - impulse.transpose() @ through_momentum)
            store(x_adjoint, scene, p, through_x, 3)
            store(v_adjoint, scene, p, mass[p] * through_momentum, 3)
            through_impulse *= self.real(self.dx)
            through_stress = -0.5 * factor * (through_impulse + through_impulse.transpose())
            through_b = unpack_adjoint(vector(b_adjoint, scene, p, 6))
            through_trial, through_material = update_adjoint(
                values,
                vectors,
                stretch,
                deviator,
                norm,
                limit,
                roots,
                elastic[0],
                elastic[1],
                through_b,
                through_stress,
                self.real,
            )
            through_step = 2.0 * through_trial @ step @ before
            store_matrix(C_adjoint, scene, p, mass[p] * through_impulse + self.real(self.dt) * through_step)
            store(b_adjoint, scene, p, pack_adjoint(step.transpose() @ through_trial @ step), 6)
            store(material_adjoint, scene, p, vector(material_adjoint, scene, p, 3) + through_material, 3)
