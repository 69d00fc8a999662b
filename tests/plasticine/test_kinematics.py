from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from scipy.linalg import expm
from torch import Tensor

from rpg.plasticine.backend import MOTION
from rpg.plasticine.kinematics import (
    Rig,
    quaternion_product,
    rotation_matrix,
    rotation_quaternion,
)
from rpg.plasticine.scenes import MOTIONS, SceneConfig, ToolConfig, load_config, scene_names

DATA = Path(__file__).parents[1] / "data" / "plasticine"
PUBLISHED = {
    "Move": "move",
    "Rollingpin": "rolling_pin",
    "Torus": "torus",
    "Rope": "rope",
    "Writer": "writer",
}
DT, SUBSTEPS = 1e-4, 19


def float64(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def tool(motion: str, **changes: object) -> ToolConfig:
    shape, size = {"chopsticks": ("chopsticks", [0.2, 0.02]), "roll": ("capsule", [0.3, 0.03])}.get(
        motion, ("sphere", [0.03])
    )
    settings: dict = {
        "shape": shape, "size": size, "position": [0.5, 0.4, 0.6], "rotation": [0.6, 0.5, -0.3, 0.2],
        "motion": motion, "scale": [0.1 + 0.02 * i for i in range(len(MOTIONS[motion]))],
    }  # fmt: skip
    if motion == "chopsticks":
        settings |= {"gap": 0.3, "min_gap": 0.05}
    return ToolConfig(**(settings | changes))


def rig(*motions: str, **changes: object) -> Rig:
    return Rig([tool(m, **changes) for m in motions], SUBSTEPS, DT)


def one_by_one(rigs: Rig, config: ToolConfig, pose: Tensor, action: Tensor) -> list[Tensor]:
    """Poses of a single tool, advanced substep by substep as facts state it: the long way round."""
    change = [a * s / SUBSTEPS for a, s in zip(action.clamp(-1, 1).tolist(), config.scale, strict=True)]
    low, high = float64(config.lower), float64(config.upper)
    poses = [pose]
    for _ in range(SUBSTEPS):
        p, q, gap = poses[-1][:3], poses[-1][3:7], poses[-1][7:]
        move, world, body, widen = (
            float64([0.0] * 3),
            float64([0.0] * 3),
            float64([0.0] * 3),
            0.0,
        )
        if config.motion == "roll":
            axis = rotation_matrix(q) @ float64([0.0, -1.0, 0.0])
            up = float64([0.0, 1.0, 0.0])
            move = torch.linalg.cross(up, axis) * change[0] * config.size[1]
            move[1] = change[2]
            world[1], body[1] = -change[1], change[0]
        elif config.motion != "fixed":
            move = float64(change[:3])
            turn = float64(change[3:6] or [0.0] * 3)
            world, body = (turn, body) if config.motion == "pose" else (world, turn)
            widen = -change[6] if config.motion == "chopsticks" else 0.0
        q = quaternion_product(rotation_quaternion(world), quaternion_product(q, rotation_quaternion(body)))
        p = torch.minimum(torch.maximum(p + move, low), high)
        poses.append(torch.cat([p, q / q.norm(), (gap + widen).clamp(min=config.min_gap)]))
    return poses


@pytest.mark.parametrize("bounded", [False, True], ids=["free", "at bounds"])
@pytest.mark.parametrize("motion", list(MOTIONS))
def test_closed_form_is_the_sum_of_substeps(motion: str, bounded: bool) -> None:
    changes: dict = {"upper": [0.503, 0.41, 0.601], "lower": [0.497, 0.39, 0.599]} if bounded else {}
    config = tool(motion, **changes)
    rigs = Rig([config], SUBSTEPS, DT)
    action = torch.linspace(1.2, -0.8, rigs.action_dim).double()
    poses, motions = rigs.advance(rigs.start[None], action[None])
    wanted = one_by_one(rigs, config, rigs.start[0], action)
    torch.testing.assert_close(poses[0, 0], wanted[-1], atol=1e-13, rtol=0)
    for k, (before, after) in enumerate(pairwise(wanted)):
        got = motions[0, k, 0]
        r0, r1 = rotation_matrix(before[3:7]), rotation_matrix(after[3:7])
        torch.testing.assert_close(got[MOTION["origin"]], before[:3], atol=1e-13, rtol=0)
        torch.testing.assert_close(got[MOTION["rotation"]].view(3, 3), r0, atol=1e-13, rtol=0)
        torch.testing.assert_close(got[MOTION["gap"]], before[7:], atol=1e-13, rtol=0)
        # The velocity field takes every point of the tool to where the next pose has it.
        point = float64([0.3, 0.1, 0.7])
        velocity = got[MOTION["linear"]] + got[MOTION["spin"]].view(3, 3) @ (point - before[:3])
        carried = r1 @ (r0.T @ (point - before[:3])) + after[:3]
        torch.testing.assert_close(point + DT * velocity, carried, atol=1e-12, rtol=0)


def test_poses_of_the_public_release() -> None:
    runs = json.loads((DATA / "dynamics.json").read_text())["runs"]
    for key, run in runs.items():
        task, variant = key.split("-v")
        config = load_config(PUBLISHED[task], int(variant))
        rigs = Rig(config.tools, config.substeps, config.dt)
        poses, n = rigs.start[None], rigs.action_dim
        for t in range(50):
            action = [0.8 * math.sin(2 * math.pi * (t / 25 + k / n)) for k in range(n)]
            poses, _ = rigs.advance(poses, float64([action]))
        torch.testing.assert_close(poses[0, :, :7], float64(run["tools"]), atol=1e-7, rtol=0)


@pytest.mark.parametrize("motion", [m for m in MOTIONS if m != "fixed"])
def test_gradients_are_finite_differences(motion: str) -> None:
    rigs = rig(motion, "translate")
    generator = torch.Generator().manual_seed(0)
    poses = rigs.start.expand(2, -1, -1).clone().requires_grad_()
    action = (torch.rand(2, rigs.action_dim, dtype=torch.float64, generator=generator) - 0.5).requires_grad_()

    weights = [torch.randn(n, dtype=torch.float64, generator=generator) for n in (8, 25)]
    weights[1][12:24] *= DT  # velocities are large numbers

    def scalar(poses: Tensor, action: Tensor) -> Tensor:
        return sum(((t @ w).sin().sum() for t, w in zip(rigs.advance(poses, action), weights, strict=True)))

    assert torch.autograd.gradcheck(scalar, (poses, action), eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("motion", [m for m in MOTIONS if m != "fixed"])
def test_gradient_at_rest_is_finite(motion: str) -> None:
    rigs = rig(motion)
    action = torch.zeros(1, rigs.action_dim, dtype=torch.float64, requires_grad=True)
    poses, motions = rigs.advance(rigs.start[None], action)
    (gradient,) = torch.autograd.grad(poses.sum() + motions.sum(), action)
    assert gradient.isfinite().all()
    assert (gradient != 0).all()


def test_rotation_vectors_turn_by_their_length_on_both_sides_of_the_change_of_formula() -> None:
    w = float64([0.3, -0.5, 0.2])
    w = w / w.norm()
    for angle in (0.0, 1e-9, 0.0632, 0.0633, 1.0, math.pi):
        wanted = torch.from_numpy(expm(generator(w * angle).numpy()))
        torch.testing.assert_close(
            rotation_matrix(rotation_quaternion(w * angle)), wanted, atol=1e-14, rtol=0
        )


def generator(w: Tensor) -> Tensor:
    x, y, z = w.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


def test_actions_beyond_one_are_clipped_and_have_no_gradient() -> None:
    rigs = rig("translate")
    action = torch.tensor([[3.0, 0.5, -2.0]], dtype=torch.float64, requires_grad=True)
    poses, _ = rigs.advance(rigs.start[None], action)
    torch.testing.assert_close(
        poses[0, 0, :3] - rigs.start[0, :3], float64([0.1, 0.06, -0.14]), atol=1e-7, rtol=0
    )
    (gradient,) = torch.autograd.grad(poses.sum(), action)
    assert (gradient != 0).tolist() == [[False, True, False]]


def test_a_tool_at_its_bound_stands_still_and_has_no_gradient() -> None:
    rigs = rig("translate", upper=[0.5, 1.0, 1.0])
    action = torch.ones(1, 3, dtype=torch.float64, requires_grad=True)
    poses, motions = rigs.advance(rigs.start[None], action)
    assert poses[0, 0, 0] == 0.5
    assert (motions[0, :, 0, 12] == 0).all()
    (gradient,) = torch.autograd.grad(poses.sum() + motions.sum(), action)
    assert (gradient != 0).tolist() == [[False, True, True]]


def test_chopsticks_do_not_close_below_their_least_gap() -> None:
    rigs = rig("chopsticks", gap=0.1, min_gap=0.06)
    for _ in range(3):
        poses, _ = rigs.advance(rigs.start[None], torch.tensor([[0, 0, 0, 0, 0, 0, 1.0]]))
    assert poses[0, 0, 7] == 0.06
    poses, _ = rigs.advance(rigs.start[None], torch.tensor([[0, 0, 0, 0, 0, 0, -1.0]]))
    assert poses[0, 0, 7] == pytest.approx(0.1 + 0.22)


def test_only_degrees_of_freedom_that_move_are_in_the_action() -> None:
    dims = {name: Rig(load_config(name).tools, SUBSTEPS, DT).action_dim for name in scene_names()}
    assert dims == {
        "assembly": 6, "chopsticks": 7, "move": 6, "pinch": 3, "rolling_pin": 3, "rope": 6, "table": 2, "torus": 3,
        "triple_move": 18, "writer": 3,
    }  # fmt: skip
    table = Rig(load_config("table").tools, SUBSTEPS, DT)
    assert table.names == ["tools[0].x", "tools[0].z"]
    poses, _ = table.advance(table.start[None], torch.tensor([[1.0, -1.0]]))
    assert poses[0, 0, :3].tolist() == pytest.approx([0.53, 0.06, 0.47])


def test_a_scene_without_tools_has_no_action() -> None:
    rigs = Rig(SceneConfig().tools, SUBSTEPS, DT)
    poses, motions = rigs.advance(rigs.start.expand(3, 0, 8), torch.zeros(3, 0))
    assert (poses.shape, motions.shape) == ((3, 0, 8), (3, SUBSTEPS, 0, 25))


def test_batch_members_do_not_mix() -> None:
    rigs = rig("roll", "chopsticks", "translate", "fixed", "pose")
    actions = torch.rand(4, rigs.action_dim, dtype=torch.float64) * 2 - 1
    together = rigs.advance(rigs.start.expand(4, -1, -1), actions)
    for i in range(4):
        alone = rigs.advance(rigs.start[None], actions[i : i + 1])
        for a, b in zip(together, alone, strict=True):
            torch.testing.assert_close(a[i : i + 1], b, atol=1e-13, rtol=1e-13)
