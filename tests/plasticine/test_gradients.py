"""Gradients of whole scenes against central differences in float64, away from kinks and where spectra degenerate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from dough import CELL, STICKY, idle, moving, repeated, run, scene, sphere, strained
from torch import Tensor

from rpg.plasticine.scene import Scene
from rpg.plasticine.state import State

STEPS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # of the differences; the best one counts
NEVER, ALWAYS = 1e6, 0.5  # yield stresses
CLOSE = 1e-4
Function = Callable[[Tensor], Tensor]


def relative_error(function: Function, size: int) -> float:
    """Of the directional derivative of ``function`` at 0, (size,), in a random direction."""
    direction = torch.randn(size, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    at = torch.zeros(size, dtype=torch.float64, requires_grad=True)
    function(at).backward()
    assert at.grad is not None
    exact = float(at.grad @ direction)
    assert exact != 0
    with torch.no_grad():
        differences = [float(function(h * direction) - function(-h * direction)) / (2 * h) for h in STEPS]
    return min(abs(difference - exact) for difference in differences) / abs(exact)


def objective(state: State) -> Tensor:
    """A fixed random mixture of all that a state holds, every part of which matters."""
    generator = torch.Generator().manual_seed(7)
    total = torch.zeros((), dtype=torch.float64)
    for part, scale in zip(state.particles, (1e-3, 0.1, 10.0, 1e-2), strict=True):
        weights = torch.randn(part.shape, generator=generator, dtype=torch.float64)
        total = total + (weights * part).sum() / scale
    return total


def pressed(yield_stress: float, substeps: int) -> tuple[Scene, State]:
    """A block that flies up and into a sphere on its way down, every particle strained in its own way."""

    def made(substeps: int) -> Scene:
        tool = sphere(0.5, 0.605, 0.5, radius=0.06, scale=0.01 * substeps / 19)
        given: dict[str, Any] = {
            "substeps": substeps,
            "yield_stress": yield_stress,
            "gravity": [3.0, -30.0, 0.0],
        }
        return scene(tool, particles=80, size=(0.12,) * 3, **given)

    warm = made(19)
    noise = torch.randn(80, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    start = moving(warm.initial_state(), torch.tensor([0.2, 2.0, -0.1]) + 0.5 * noise)
    return made(substeps), run(warm, repeated((0.1, -0.8, 0.2), 1), start)[-1]


def varied(scene: Scene, state: State, wrt: str) -> tuple[Function, int]:
    """The objective after another step, with what ``wrt`` names moved by the argument."""
    n, yields = scene.n_particles, float(state.material[0, 0, 2])
    action = torch.tensor([0.3, -0.9, 0.4], dtype=torch.float64)

    def after(d: Tensor) -> Tensor:
        start, push = state, action
        if wrt == "actions":
            push = action + d
        elif wrt == "positions":
            x = state.particles.x + d.view(1, n, 3) * scene.physics.dx
            start = state._replace(particles=state.particles._replace(x=x))
        elif wrt == "E":
            start = state._replace(material=scene.material(E=5000 * d.exp())[None])
        else:
            start = state._replace(material=scene.material(yield_stress=yields * d.exp())[None])
        return objective(scene.step(start, push))

    return after, {"actions": 3, "positions": 3 * n}.get(wrt, n)


@pytest.mark.parametrize("substeps", [1, 19])
@pytest.mark.parametrize("yield_stress", [NEVER, ALWAYS], ids=["elastic", "flowing"])
@pytest.mark.parametrize("wrt", ["actions", "positions", "E", "yield"])
def test_against_differences(wrt: str, yield_stress: float, substeps: int) -> None:
    block, state = pressed(yield_stress, substeps)
    function, size = varied(block, state, wrt)
    if (wrt, yield_stress) == ("yield", NEVER):
        at = torch.zeros(size, dtype=torch.float64, requires_grad=True)
        function(at).backward()
        assert at.grad is not None
        assert at.grad.abs().max() == 0
    else:
        assert relative_error(function, size) < CLOSE


def velocities(scene: Scene, state: State, action: Tensor) -> Function:
    """The objective after a step, with all velocities moved by the argument."""

    def after(d: Tensor) -> Tensor:
        return objective(scene.step(moving(state, state.particles.v + d.view_as(state.particles.v)), action))

    return after


TURNED = [0.9, 0.1, 0.1, 0.05]
TOOLS: dict[str, dict[str, Any]] = {
    "pin": {"shape": "capsule", "size": [0.2, 0.05], "motion": "roll", "rotation": [0.707, 0.707, 0.0, 0.0]},
    "capsule": {"shape": "capsule", "size": [0.2, 0.05], "motion": "pose", "rotation": [0.6, 0.5, 0.2, 0.1]},
    "box": {"shape": "box", "size": [0.06, 0.05, 0.07], "motion": "pose", "rotation": TURNED},
    "cylinder": {"shape": "cylinder", "size": [0.06, 0.05], "motion": "pose", "rotation": TURNED},
    "torus": {"shape": "torus", "size": [0.06, 0.04], "motion": "pose", "rotation": TURNED},
    "chopsticks": {
        "shape": "chopsticks", "size": [0.2, 0.03], "motion": "chopsticks", "rotation": TURNED, "gap": 0.08,
        "min_gap": 0.05,
    },
}  # fmt: skip
SCALES = {
    "roll": [0.6, 0.06, 0.01],
    "pose": [0.01] * 3 + [0.1] * 3,
    "chopsticks": [0.01] * 3 + [0.1] * 3 + [0.02],
}


@pytest.mark.parametrize("name", TOOLS)
def test_every_tool_and_motion_against_differences(name: str) -> None:
    tool = TOOLS[name]
    height = 0.68 if name == "chopsticks" else 0.6
    made = scene(
        tool | {"position": [0.5, height, 0.5], "scale": SCALES[tool["motion"]]},
        particles=80,
        size=(0.12,) * 3,
        sweeps=6,
    )
    noise = torch.randn(80, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    start = moving(made.initial_state(), torch.tensor([0.2, 2.0, -0.1]) + 0.5 * noise)
    state = run(made, torch.full((1, made.action_dim), -0.3, dtype=torch.float64), start)[-1]
    action = torch.linspace(-0.7, 0.8, made.action_dim).double()
    assert relative_error(lambda d: objective(made.step(state, action + d)), made.action_dim) < CLOSE
    assert relative_error(velocities(made, state, action), 3 * made.n_particles) < CLOSE


@pytest.mark.parametrize("friction", [0.0, 0.5, 1.5, STICKY])
def test_every_floor_against_differences(friction: float) -> None:
    made = scene(
        particles=80, size=(0.12,) * 3, centre=(0.5, 2 * CELL + 0.05, 0.5), floor_friction=friction, sweeps=6
    )
    noise = torch.randn(80, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    state = idle(made, 1, moving(made.initial_state(), torch.tensor([1.0, -2.0, 0.5]) + 0.5 * noise))[-1]
    none = torch.zeros(0, dtype=torch.float64)
    assert relative_error(velocities(made, state, none), 3 * made.n_particles) < CLOSE


_TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))[0]


def _six(b: Tensor) -> Tensor:
    return b.flatten()[[0, 1, 2, 4, 5, 8]]


SPECTRA = {
    "rest": _six(torch.eye(3, dtype=torch.float64)),
    "uniform": _six(0.9 * torch.eye(3, dtype=torch.float64)),
    "uniaxial": _six(torch.diag(torch.tensor([1.1, 1.0, 1.0], dtype=torch.float64))),
    "uniaxial, turned": _six(
        _TURN @ torch.diag(torch.tensor([0.9, 1.0, 1.0], dtype=torch.float64)) @ _TURN.T
    ),
    "nearly equal": _six(
        _TURN @ torch.diag(torch.tensor([1.0, 1.0 + 1e-7, 1.0 - 1e-9], dtype=torch.float64)) @ _TURN.T
    ),
}


@pytest.mark.parametrize("substeps", [1, 19])
@pytest.mark.parametrize("yield_stress", [NEVER, ALWAYS], ids=["elastic", "flowing"])
@pytest.mark.parametrize("spectrum", SPECTRA)
def test_where_eigenvalues_are_equal(spectrum: str, yield_stress: float, substeps: int) -> None:
    """The state at rest is the start of every scene. In every direction, not only in those that keep it degenerate."""
    block = scene(particles=60, size=(0.12,) * 3, substeps=substeps, yield_stress=yield_stress)
    state = strained(block.initial_state(), SPECTRA[spectrum])
    n = block.n_particles
    none = torch.zeros(0, dtype=torch.float64)

    def of_strain(d: Tensor) -> Tensor:
        particles = state.particles._replace(b=state.particles.b + d.view(1, n, 6))
        return objective(block.step(state._replace(particles=particles), none))

    assert relative_error(of_strain, 6 * n) < CLOSE

    def of_motion(d: Tensor) -> Tensor:
        particles = state.particles._replace(C=state.particles.C + 100 * d.view(1, n, 3, 3))
        return objective(block.step(state._replace(particles=particles), none))

    assert relative_error(of_motion, 9 * n) < CLOSE


def test_float32_agrees_with_float64_from_the_state_at_rest() -> None:
    """Where the public release divides rounding errors by differences of equal singular values."""
    gradients = {}
    for dtype in ("float32", "float64"):
        block = scene(sphere(0.5, 0.6, 0.5), particles=300, size=(0.12,) * 3, dtype=dtype)
        actions = repeated((0.1, -0.9, 0.2), 3).clone().requires_grad_()
        rollout = block.rollout(actions)
        (rollout.final.particles.x.double() ** 2).sum().backward()
        assert actions.grad is not None
        gradients[dtype] = actions.grad.flatten()
    full = gradients["float64"]
    assert float((gradients["float32"] - full).norm() / full.norm()) < 1e-3


def test_a_rollout_is_its_steps() -> None:
    """The gradient of the first action through states that are kept, and through one that is handed on."""
    block = scene(sphere(0.5, 0.6, 0.5), particles=80, size=(0.12,) * 3)
    actions = repeated((0.1, -0.9, 0.2), 4).clone().requires_grad_()
    (whole,) = torch.autograd.grad(objective(block.rollout(actions).final), actions)
    middle = block.rollout(actions[:2]).final
    handed = State(
        type(middle.particles)(*(t.detach().requires_grad_() for t in middle.particles)),
        middle.poses.detach().requires_grad_(),
        middle.material.detach(),
        middle.time,
    )
    end = objective(block.rollout(actions[2:], state=handed).final)
    pull = torch.autograd.grad(end, (*handed.particles, handed.poses))
    (first,) = torch.autograd.grad((*middle.particles, middle.poses), actions, pull)
    torch.testing.assert_close(first[:2], whole[:2], rtol=1e-12, atol=0)
