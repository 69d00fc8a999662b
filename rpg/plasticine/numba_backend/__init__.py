"""The CPU backend of the simulator: hand-written kernels for a substep and its adjoint, compiled by numba."""

from rpg.plasticine.numba_backend.backend import NumbaBackend

__all__ = ["NumbaBackend"]
