"""Tools on rails: an action becomes a displacement over one environment step, and that the motion of every substep.

Rotations are exponentials with a constant rate over the step, ``R_k = exp(k w / n) R_0 exp(k u / n)`` with w in axes of
the world and u in those of the tool, so that every substep is known at once. All in float64 and differentiable.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rpg.plasticine.backend import MOTION_SIZE
from rpg.plasticine.scenes import MOTIONS, ToolConfig

POSE_SIZE = 8  # position 3, quaternion w x y z, gap

# What one action can change in a tool: translation, turn in the world's axes, turn in its own, gap, roll of a pin.
_LINEAR, _WORLD, _BODY, _GAP, _ROLL = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 10), slice(10, 11)
_CHANGES = 11
_ROWS = {
    "fixed": (),
    "translate": ((0, 1.0), (1, 1.0), (2, 1.0)),
    "pose": ((0, 1.0), (1, 1.0), (2, 1.0), (3, 1.0), (4, 1.0), (5, 1.0)),
    "roll": ((7, 1.0), (4, -1.0), (1, 1.0)),  # about the pin's own y; about -y of the world; up
    "chopsticks": ((0, 1.0), (1, 1.0), (2, 1.0), (6, 1.0), (7, 1.0), (8, 1.0), (9, -1.0)),
}


def _bilinear(terms: str) -> Tensor:
    """Matrix that takes the outer product of two quaternions, (16,), to bilinear forms such as ``ww-xx``."""
    rows = terms.split()
    table = torch.zeros(16, len(rows), dtype=torch.float64)
    for column, row in enumerate(rows):
        for sign, a, b in zip(row[0::3], row[1::3], row[2::3], strict=True):
            table["wxyz".index(a) * 4 + "wxyz".index(b), column] += 1.0 if sign == "+" else -1.0
    return table


_PRODUCT = _bilinear("+ww-xx-yy-zz +wx+xw+yz-zy +wy-xz+yw+zx +wz+xy-yx+zw")
_MATRIX = _bilinear(
    "+ww+xx-yy-zz +xy+xy-wz-wz +xz+xz+wy+wy "
    "+xy+xy+wz+wz +ww-xx+yy-zz +yz+yz-wx-wx "
    "+xz+xz-wy-wy +yz+yz+wx+wx +ww-xx-yy+zz"
)
# Rotation less identity, of a unit quaternion: small rotations keep their digits.
_TURN = _bilinear(
    "-yy-yy-zz-zz +xy+xy-wz-wz +xz+xz+wy+wy "
    "+xy+xy+wz+wz -xx-xx-zz-zz +yz+yz-wx-wx "
    "+xz+xz-wy-wy +yz+yz+wx+wx -xx-xx-yy-yy"
)
_CONJUGATE = torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64)


def _product(rows: Tensor, table: Tensor) -> Tensor:
    """``rows @ table`` for tables this small.

    A library's product starts threads for it, which then go on spinning where the simulator's are to run.
    """
    return (rows.unsqueeze(-1) * table).sum(-2)


def _forms(a: Tensor, b: Tensor, table: Tensor) -> Tensor:
    return _product((a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(-2), table.to(a))


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton's product of quaternions (..., 4), w first."""
    return _forms(a, b, _PRODUCT)


def rotation_matrix(q: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of quaternions (..., 4) of any length."""
    return (_forms(q, q, _MATRIX) / (q * q).sum(-1, keepdim=True)).unflatten(-1, (3, 3))


def rotation_quaternion(w: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of rotation vectors (..., 3), radians; smooth at zero."""
    t = (w * w).sum(-1, keepdim=True) / 4
    # Taylor's series where the quotient loses its digits, and derivatives are 0 / 0.
    small = t < 1e-3
    half = torch.where(small, 1.0, t).sqrt()
    cos = torch.where(small, 1 - t / 2 * (1 - t / 12 * (1 - t / 30)), half.cos())
    sinc = torch.where(small, 1 - t / 6 * (1 - t / 20 * (1 - t / 42)), half.sin() / half)
    return torch.cat([cos, 0.5 * sinc * w], -1)


class Rig:
    """All tools of a scene: where they start, what an action does to them.

    Attributes:
        action_dim: numbers of an action; degrees of freedom with scale 0 have none.
        movable: indices of tools with at least one degree of freedom.
        start: poses at the start, (tools, 8).
    """

    def __init__(self, tools: list[ToolConfig], substeps: int, dt: float, device: str = "cpu") -> None:
        """Args:
        tools: as in the scene.
        substeps: substeps of an environment step.
        dt: seconds of a substep.
        device: where poses live.
        """
        self.substeps, self.dt = substeps, dt

        def column(values: list[Any], width: int) -> Tensor:
            return torch.tensor(values, dtype=torch.float64, device=device).reshape(len(values), width)

        self._steps = column(list(range(substeps + 1)), 1)[:, None] / substeps
        rows: list[list[float]] = []
        self.names: list[str] = []
        for index, tool in enumerate(tools):
            for scale, (change, sign), name in zip(
                tool.scale, _ROWS[tool.motion], MOTIONS[tool.motion], strict=True
            ):
                if scale != 0:
                    row = [0.0] * (len(tools) * _CHANGES)
                    row[index * _CHANGES + change] = sign * scale
                    if name == "roll":
                        # Rolling without slip: the axis advances by the angle times the pin's radius.
                        row[index * _CHANGES + _ROLL.start] = scale * tool.size[1]
                    rows.append(row)
                    self.names.append(f"tools[{index}].{name}")
        self.action_dim = len(rows)
        self._changes = column(rows, len(tools) * _CHANGES)
        self.movable = tuple(i for i, tool in enumerate(tools) if any(tool.scale))
        self._rotates = any(tool.motion in ("pose", "roll", "chopsticks") for tool in tools)
        self._rolls = any(tool.motion == "roll" for tool in tools)
        self._grips = any(tool.motion == "chopsticks" for tool in tools)
        self._lower = column([tool.lower for tool in tools], 3)
        self._upper = column([tool.upper for tool in tools], 3)
        self._min_gap = column([tool.min_gap for tool in tools], 1)
        rotation = column([tool.rotation for tool in tools], 4)
        rotation = rotation / rotation.norm(dim=-1, keepdim=True)
        start = [
            column([tool.position for tool in tools], 3),
            rotation,
            column([tool.gap for tool in tools], 1),
        ]
        self.start = torch.cat(start, -1)

    def advance(self, poses: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Move all tools through one environment step.

        Args:
            poses: before it, (B, tools, 8).
            action: (B, action_dim), clipped to [-1, 1]; the gradient of a clipped number is zero.

        Returns:
            Poses after it, (B, tools, 8), and the motion of every substep, (B, substeps, tools, 25), see
            `rpg.plasticine.backend.MOTION`.
        """
        batch, tools = poses.shape[:2]
        if tools == 0:
            return poses, poses.new_zeros(batch, self.substeps, 0, MOTION_SIZE)
        change = _product(action.to(self._changes).clamp(-1.0, 1.0), self._changes)
        change = change.unflatten(-1, (tools, _CHANGES))
        position, turn, gap = poses[..., :3], poses[..., 3:7], poses[..., 7:]
        path = self._path(position, turn, change)
        wide = (batch, self.substeps, tools)
        if self._rotates:
            ways = change[:, None] * self._steps
            turns = quaternion_product(
                rotation_quaternion(ways[..., _WORLD]),
                quaternion_product(turn[:, None], rotation_quaternion(ways[..., _BODY])),
            )
            turns = turns / turns.norm(dim=-1, keepdim=True)
            begin = rotation_matrix(turns[:, :-1]).flatten(-2)
            between = quaternion_product(turns[:, 1:], turns[:, :-1] * _CONJUGATE.to(turns.device))
            spin = _forms(between, between, _TURN) / self.dt
            turn = turns[:, -1]
        else:
            begin = rotation_matrix(turn).flatten(-2)[:, None].expand(*wide, 9)
            spin = begin.new_zeros(1).expand(*wide, 9)
        if self._grips:
            gaps = torch.maximum(gap[:, None] + self._steps * change[:, None, :, _GAP], self._min_gap)
        else:
            gaps = gap[:, None].expand(batch, self.substeps + 1, tools, 1)
        linear = (path[:, 1:] - path[:, :-1]) / self.dt
        motion = torch.cat([path[:, :-1], begin, linear, spin, gaps[:, :-1]], -1)
        return torch.cat([path[:, -1], turn, gaps[:, -1]], -1), motion

    def _path(self, position: Tensor, turn: Tensor, change: Tensor) -> Tensor:
        """Positions before and after every substep, (B, substeps + 1, tools, 3), within the bounds."""
        # On a straight way, to clamp once is to clamp after every substep.
        straight = position[:, None] + self._steps * change[:, None, :, _LINEAR]
        if not self._rolls:
            return torch.minimum(torch.maximum(straight, self._lower), self._upper)
        axis = rotation_matrix(turn)[:, None, :, :, 1]
        angle = change[:, None, :, _WORLD][..., 1] * self._steps[:-1, :, 0]
        cos, sin = angle.cos(), angle.sin()
        x, z = -axis[..., 2], axis[..., 0]  # up x (-axis), which turns about the vertical with the pin
        heading = torch.stack([cos * x + sin * z, torch.zeros_like(cos), cos * z - sin * x], -1)
        rolled = heading * (change[:, None, :, _ROLL] / self.substeps)
        path = straight + torch.cat([torch.zeros_like(rolled[:, :1]), rolled.cumsum(1)], 1)
        if bool(((path >= self._lower) & (path <= self._upper)).all()):
            return path
        moves = path[:, 1:] - path[:, :-1]
        points = [torch.minimum(torch.maximum(path[:, 0], self._lower), self._upper)]
        for k in range(self.substeps):
            points.append(torch.minimum(torch.maximum(points[-1] + moves[:, k], self._lower), self._upper))
        return torch.stack(points, 1)
