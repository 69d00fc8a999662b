"""The simulator in Taichi: CPU and CUDA, and the version to read if you want to understand the method.

The adjoints are written out by hand. Taichi's reverse mode takes a kernel whole and with its loops unrolled: for the
27 nodes of a scatter with the material inside, some 300 s of compilation. By hand the loops stay loops, equal
eigenvalues are exact, and all kernels of a scene up to the first gradient take some 10 s, or 2 s from Taichi's cache.

Read `particle_kernels` first (a substep is scatter, `grid_kernels`, gather), then `material` and `contact`.
"""

from rpg.plasticine.taichi_backend.backend import TaichiBackend

__all__ = ["TaichiBackend"]
