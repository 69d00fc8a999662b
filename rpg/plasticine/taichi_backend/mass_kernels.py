# mypy: allow-untyped-defs, allow-incomplete-defs
# (Taichi takes any annotation of a kernel's result, None too, for a value to return.)
"""Mass of the particles on the whole grid, as losses and scores see it, and its adjoint.

Arrays: ``x`` (B, N, 3), ``mass`` (N,), ``grid`` (lanes, B, nodes, nodes, nodes). A node outside the grid gets nothing.
Workers and lanes are those of `rpg.plasticine.taichi_backend.particle_kernels`.
"""

from rpg.plasticine.taichi_backend.stencil import spline, spline_slope
from rpg.plasticine.taichi_backend.types import Array, Int, Real, Value, func, kernel
from rpg.plasticine.taichi_module import ti


@ti.data_oriented
class MassKernels:
    """Kernels for one dtype and one number of nodes per unit length; ``private`` as in `ParticleKernels`."""

    def __init__(self, real: Real, nodes: int, private: bool) -> None:
        self.real, self.nodes, self.private = real, nodes, private

    @func
    def base(self, x: Array, scene: Value, p: Value) -> Value:
        """First node of a particle's 27, kept where integers can be, and the distance from it in cells."""
        base, f = ti.Vector.zero(ti.i32, 3), ti.Vector.zero(self.real, 3)
        for i in ti.static(range(3)):
            f[i] = x[scene, p, i] * self.nodes
            base[i] = ti.min(ti.max(ti.cast(ti.floor(f[i] - 0.5), ti.i32), -3), self.nodes)
            f[i] -= base[i]
        return base, f

    @func
    def inside(self, i: Value, j: Value, k: Value) -> Value:
        """Whether a node belongs to the grid."""
        return ti.min(i, ti.min(j, k)) >= 0 and ti.max(i, ti.max(j, k)) < self.nodes

    @kernel
    def scatter(self, x: Array, mass: Array, grid: Array, workers: Int):
        """Add the mass of all particles."""
        for worker in range(x.shape[0] * workers):
            scene, first = worker // workers, worker % workers
            share = (x.shape[1] + workers - 1) // workers
            for p in range(first * share, ti.min(x.shape[1], (first + 1) * share)):
                base, f = self.base(x, scene, p)
                for i, j, k in ti.ndrange(3, 3, 3):
                    a, b, c = base[0] + i, base[1] + j, base[2] + k
                    if self.inside(a, b, c):
                        value = mass[p] * spline(f[0], i) * spline(f[1], j) * spline(f[2], k)
                        if ti.static(self.private):
                            grid[first, scene, a, b, c] = grid[first, scene, a, b, c] + value
                        else:
                            grid[0, scene, a, b, c] += value

    @kernel
    def gather_slope(self, x: Array, mass: Array, gradient: Array, x_adjoint: Array):
        """Adjoint of the positions from that of the mass on the grid, (B, nodes, nodes, nodes)."""
        for scene, p in ti.ndrange(x.shape[0], x.shape[1]):
            base, f = self.base(x, scene, p)
            slope = ti.Vector.zero(self.real, 3)
            for i, j, k in ti.ndrange(3, 3, 3):
                a, b, c = base[0] + i, base[1] + j, base[2] + k
                if self.inside(a, b, c):
                    along = ti.Vector([spline(f[0], i), spline(f[1], j), spline(f[2], k)])
                    value = gradient[scene, a, b, c]
                    slope[0] += value * spline_slope(f[0], i) * along[1] * along[2]
                    slope[1] += value * along[0] * spline_slope(f[1], j) * along[2]
                    slope[2] += value * along[0] * along[1] * spline_slope(f[2], k)
            for n in ti.static(range(3)):
                x_adjoint[scene, p, n] = slope[n] * mass[p] * self.nodes
