"""What a scene's physics is made of: grid, time step, contact, and the tools that touch the bodies (thesis 2.4)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from rpg.errors import RPGError

Dtype = Literal["float32", "float64"]
Shape = Literal["sphere", "capsule", "box", "cylinder", "torus", "chopsticks"]

# How many numbers describe each shape, all lengths in units of the domain's edge.
SHAPES: dict[str, tuple[str, ...]] = {
    "sphere": ("radius",),
    "capsule": ("length", "radius"),  # a segment along the local y axis, centred
    "box": ("half_x", "half_y", "half_z"),
    "cylinder": ("radius", "half_height"),  # axis along the local y axis
    "torus": ("major_radius", "minor_radius"),  # axis along the local y axis
    "chopsticks": (
        "length",
        "radius",
    ),  # two capsules from local y = -length to 0 at local x = -gap/2, +gap/2
}


@dataclass(frozen=True)
class Physics:
    """Discretisation and global constants of a scene. Lengths in units of the domain's edge, seconds.

    Attributes:
        grid: grid nodes per unit length; the cell is dx = 1 / grid.
        dt: seconds of one substep.
        substeps: substeps of one environment step.
        gravity: acceleration.
        floor_friction: 0 slips, at 10 and above everything sticks, in between Coulomb's coefficient.
        dtype: of particles and grid.
        sweeps: Jacobi sweeps of the symmetric 3x3 eigenproblem of the material.
    """

    grid: int = 64
    dt: float = 1e-4
    substeps: int = 19
    gravity: tuple[float, float, float] = (0.0, -30.0, 0.0)
    floor_friction: float = 1.5
    dtype: Dtype = "float32"
    sweeps: int = 3

    def __post_init__(self) -> None:
        for name in ("grid", "dt", "substeps", "sweeps"):
            if not getattr(self, name) > 0:
                raise RPGError(f"physics.{name}={getattr(self, name)} must be positive")
        if self.grid < 8:
            raise RPGError(f"physics.grid={self.grid} leaves no room between the walls; use 8 or more")
        if self.floor_friction < 0:
            raise RPGError(f"physics.floor_friction={self.floor_friction} must not be negative")
        if self.dtype not in ("float32", "float64"):
            raise RPGError(f"physics.dtype={self.dtype!r} is unknown; use float32 or float64")

    @property
    def dx(self) -> float:
        """Edge of a grid cell."""
        return 1.0 / self.grid

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The names of all settings."""
        return tuple(field.name for field in fields(cls))


@dataclass(frozen=True)
class Tool:
    """Surface of a kinematic manipulator: a signed distance function in its own frame.

    Attributes:
        shape: one of `SHAPES`.
        size: the numbers that `SHAPES` names for it.
        friction: Coulomb's coefficient between it and the bodies.
    """

    shape: Shape
    size: tuple[float, ...]
    friction: float = 0.9

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise RPGError(f"a tool of shape {self.shape!r} is unknown; use one of {', '.join(SHAPES)}")
        if len(self.size) != len(SHAPES[self.shape]) or min(self.size) <= 0:
            wanted = ", ".join(SHAPES[self.shape])
            raise RPGError(f"a {self.shape} has the sizes ({wanted}), all positive; got {self.size}")
        if self.friction < 0:
            raise RPGError(f"a tool's friction={self.friction} must not be negative")
