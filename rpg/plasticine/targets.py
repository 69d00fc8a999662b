"""Target shapes: masses on a grid, from the public benchmark's file or from this package's own."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from rpg.errors import RPGError, nearest
from rpg.plasticine.score import score_mass

ENV_VAR = "RPG_PLASTICINE_TARGETS"
SDF_THRESHOLD = 1e-4  # mass above which a node of the published grid (64) belongs to the target
PUBLIC_GRID = 64


@dataclass(frozen=True)
class Target:
    """What a scene is to become.

    Attributes:
        mass: on the target's own grid, float64, for scores.
        source: which file it is from.
    """

    mass: Tensor
    source: str

    @property
    def grid(self) -> int:
        """Nodes per unit length of its own grid."""
        return self.mass.shape[-1]

    def on_grid(self, grid: int) -> tuple[Tensor, Tensor]:
        """Mass and distance field for losses on another grid, float64, (grid, grid, grid) each.

        The distance of a node is to the nearest node of the target, 0 inside (Euclidean, unit of the domain's edge).
        """
        mass = self.mass if grid == self.grid else _resample(self.mass, grid)
        threshold = SDF_THRESHOLD * (PUBLIC_GRID / grid) ** 3
        inside = (mass > threshold).numpy()
        if not inside.any():
            raise RPGError(f"target {self.source} is empty: no node has a mass above {threshold:.3g}")
        return mass, torch.from_numpy(distance_transform_edt(~inside) / grid)


def load_target(key: str, source: str | None = None) -> Target:
    """A target by its key, such as ``Move-v1``, or from a file.

    Args:
        key: task and variant; or a .npy file with masses (n, n, n), which ``source`` does not touch.
        source: public, own, a .npz file, or None for public where the variable RPG_PLASTICINE_TARGETS names its
            file, else own.

    Raises:
        RPGError: file or key not there, or not the masses of a cube.
    """
    if key.endswith(".npy"):
        return Target(_cube(_open(Path(key)), key), key)
    public = os.environ.get(ENV_VAR)
    if source == "public" and not public:
        raise RPGError(
            f"targets=public: set {ENV_VAR} to the benchmark's file of targets, or take targets=own"
        )
    if source is None:
        source = "public" if public else "own"
    if source == "own":
        return Target(_read_own(key), f"own:{key}")
    path = Path(str(public)) if source == "public" else Path(source)
    with _open(path) as archive:
        if key not in archive:
            raise RPGError(f"targets {path} hold no {key!r}; {nearest(key, archive.files)}")
        return Target(_cube(archive[key], f"{path}:{key}"), f"{source}:{key}")


def _open(path: Path) -> Any:
    try:
        return np.load(path)
    except (OSError, ValueError) as error:
        raise RPGError(f"targets {str(path)!r} cannot be read: {error}") from error


def _cube(array: np.ndarray, what: str) -> Tensor:
    if array.ndim != 3 or len(set(array.shape)) != 1 or not np.isfinite(array).all():
        raise RPGError(f"target {what} has shape {array.shape}; it must be finite masses on a cube (n, n, n)")
    return torch.from_numpy(array.astype(np.float64))


def pack(mass: Tensor) -> dict[str, np.ndarray]:
    """A target as few numbers: gaps between its nodes with mass, and masses in 65535ths of the greatest.

    Raises:
        RPGError: two of its nodes are more than 65535 apart.
    """
    flat = mass.flatten().numpy()
    node = np.flatnonzero(flat > flat.max() / 65535)
    gaps = np.diff(node, prepend=node[0])
    if gaps.max(initial=0) > np.iinfo(np.uint16).max:
        raise RPGError("a target with nodes more than 65535 apart cannot be packed; use a smaller grid")
    peak = np.float64(flat.max())
    return {
        "gaps": gaps.astype(np.uint16),
        "levels": np.round(flat[node] / peak * 65535).astype(np.uint16),
        "shape": np.array([mass.shape[-1], node[0]]),
        "peak": np.array([peak]),
    }


def unpack(parts: dict[str, np.ndarray]) -> Tensor:
    """The masses that `pack` made few; float64, (n, n, n), precise to 1 / 131070 of the greatest."""
    grid, first = parts["shape"].tolist()
    flat = np.zeros(grid**3)
    flat[first + np.cumsum(parts["gaps"].astype(np.int64))] = parts["levels"] * (parts["peak"][0] / 65535)
    return torch.from_numpy(flat.reshape(grid, grid, grid))


def _read_own(key: str) -> Tensor:
    path = resources.files("rpg.plasticine") / "targets.npz"
    with _open(Path(str(path))) as archive:
        names = {name.split("/")[0] for name in archive.files}
        if key not in names:
            raise RPGError(f"the package holds no target {key!r}; {nearest(key, names)}")
        return unpack({part: archive[f"{key}/{part}"] for part in ("gaps", "levels", "shape", "peak")})


def _resample(mass: Tensor, grid: int) -> Tensor:
    """The same mass on another grid: every node's mass is spread evenly over its cell, then scattered."""
    old = mass.shape[-1]
    nodes = mass.nonzero()
    parts = max(1, -(-2 * grid // old))
    offsets = (torch.arange(parts, dtype=torch.float64) + 0.5) / parts - 0.5
    cube = torch.cartesian_prod(offsets, offsets, offsets)
    points = ((nodes[:, None].double() + cube) / old).clamp(0.5 / grid, 1 - 1.5 / grid).flatten(0, 1)
    share = (mass[tuple(nodes.T)] / parts**3).repeat_interleave(parts**3)
    return score_mass(points[None], share, grid)[0]
