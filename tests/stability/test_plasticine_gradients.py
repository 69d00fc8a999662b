"""Where gradients through contact and plasticity fail, and what a solver and the guard against NaN then do."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
import torch
from dough import GRID, idle, repeated, scene, sphere, target_of, wander
from record import record
from torch.utils.hooks import RemovableHandle

from rpg.errors import NonFiniteError, RPGError
from rpg.plasticine.scene import load_scene
from rpg.plasticine.simulator import make_backend
from rpg.plasticine.solver import Solver, SolverConfig
from rpg.plasticine.state import State

# -- gradients ---------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("task", ["move", "torus", "triple_move", "chopsticks"])
def test_gradients_stay_finite_however_long_the_rollout(task: str) -> None:
    """How fast they grow is recorded; that they grow is the physics."""
    made = load_scene(task)
    for horizon in (5, 10, 20, 50, 100):
        begin = time.perf_counter()
        actions = (0.5 * wander(made.action_dim, horizon)).requires_grad_()
        made.rollout(actions).losses.sum().backward()
        assert actions.grad is not None
        norm = float(actions.grad.norm())
        finite = bool(actions.grad.isfinite().all())
        record(
            "plasticine_gradient", 0, {"task": task, "horizon": horizon}, "gradient_norm", norm, finite,
            time.perf_counter() - begin,
        )  # fmt: skip
        assert finite


def pushing_solver(tmp_path: Path, **settings: Any) -> Solver:
    """Three steps in which a sphere should push a block to the side."""
    made = scene(
        sphere(0.4, 0.5, 0.5), size=(0.12,) * 3, centre=(0.5, 0.5, 0.5), particles=100, gravity=[0.0] * 3
    )
    target = target_of(made, tmp_path, by=(0.05, 0.0, 0.0))
    made = scene(
        sphere(0.4, 0.5, 0.5), size=(0.12,) * 3, centre=(0.5, 0.5, 0.5), particles=100, gravity=[0.0] * 3,
        target=target,
    )  # fmt: skip
    given: dict[str, Any] = {"horizon": 3, "lr": 0.01, "optimizer": "gd"}
    return Solver(made, SolverConfig(**given | settings))


def times(solver: Solver, factor: float) -> RemovableHandle:
    """From now on every gradient arrives multiplied."""

    def spoil(actions: torch.Tensor) -> None:
        assert actions.grad is not None
        actions.grad.mul_(factor)

    return solver.actions.register_post_accumulate_grad_hook(spoil)


def test_an_exploding_gradient_is_cut_to_a_multiple_of_the_usual_one(tmp_path: Path) -> None:
    solver = pushing_solver(tmp_path, clip=10.0)
    ordinary = [solver.step() for _ in range(5)]
    assert not any(seen.clipped for seen in ordinary)
    handle = times(solver, 1e6)
    before = solver.actions.detach().clone()
    seen = solver.step()
    handle.remove()
    usual = sorted(seen.gradient_norm for seen in ordinary)[2]
    assert (seen.clipped, seen.skipped) == (1, 0)
    assert seen.gradient_norm > 1e4 * usual
    # Averaged gradient descent takes a tenth of the newest gradient and nine tenths of the average of those before.
    largest = max(seen.gradient_norm for seen in ordinary)
    moved = float((solver.actions.detach() - before).norm())
    assert moved < 1.001 * 0.01 * (0.1 * 10.0 * usual + 0.9 * largest)
    assert solver.step().clipped == 0


@pytest.mark.parametrize("optimizer", ["gd", "adam"])
def test_a_gradient_that_is_not_finite_is_skipped(tmp_path: Path, optimizer: str) -> None:
    solver = pushing_solver(tmp_path, optimizer=optimizer)
    for _ in range(3):
        solver.step()
    before, best = solver.actions.detach().clone(), solver.best_actions.clone()
    handle = times(solver, torch.nan)
    seen = solver.step()
    assert (seen.skipped, seen.clipped) == (1, 0)
    assert torch.equal(solver.actions.detach(), before)
    handle.remove()
    assert solver.step().skipped == 0
    assert solver.actions.isfinite().all()
    assert best.isfinite().all()


def test_a_solver_without_a_finite_gradient_stops_and_keeps_what_it_found(tmp_path: Path) -> None:
    solver = pushing_solver(tmp_path)
    solver.step()
    found = solver.best_loss
    times(solver, torch.nan)
    with pytest.raises(NonFiniteError, match="dough-v1: no finite gradient in 10 iterations"):
        for _ in range(20):
            solver.step()
    assert solver.best_loss <= found
    assert solver.best_actions.isfinite().all()
    assert all(
        t.isfinite().all() for t in (solver.state_dict()["actions"], solver.state_dict()["best_actions"])
    )


# -- numbers that are none ---------------------------------------------------------------------------------


def spoilt(state: State, place: str, value: float) -> State:
    """One number of a state replaced."""
    if place == "pose":
        poses = state.poses.clone()
        poses[0, 0, 1] = value
        return state._replace(poses=poses)
    if place in ("E", "yield"):
        material = state.material.clone()
        material[0, 3, 0 if place == "E" else 2] = value
        return state._replace(material=material)
    tensor = getattr(state.particles, place).clone()
    tensor[0, 3].view(-1)[0] = value
    return state._replace(particles=state.particles._replace(**{place: tensor}))


@pytest.mark.parametrize("near", [True, False], ids=["in contact", "far away"])
@pytest.mark.parametrize(
    ("place", "value"),
    [
        *((place, value) for place in ("x", "v", "C", "b", "E", "pose") for value in (torch.nan, torch.inf)),
        ("yield", torch.nan),  # an infinite one is an elastic body
    ],
)
def test_a_state_that_is_not_finite_is_an_error(place: str, value: float, near: bool) -> None:
    block = scene(sphere(0.5, 0.6 if near else 0.9, 0.5), size=(0.12,) * 3, particles=100)
    state = spoilt(block.initial_state(), place, value)
    with pytest.raises(NonFiniteError, match="dough-v1: environment step 1"):
        block.step(state, torch.zeros(3))


@pytest.mark.parametrize("near", [True, False], ids=["in contact", "far away"])
def test_an_action_that_is_not_finite_is_an_error(near: bool) -> None:
    block = scene(sphere(0.5, 0.6 if near else 0.9, 0.5), size=(0.12,) * 3, particles=100)
    with pytest.raises(NonFiniteError, match="an action or pose is not finite"):
        block.step(block.initial_state(), torch.tensor([0.0, torch.nan, 0.0]))


def test_the_backward_pass_never_makes_up_numbers() -> None:
    """NaN coming from the loss arrives at the actions as NaN, where a solver sees it."""
    block = scene(sphere(0.5, 0.6, 0.5), size=(0.12,) * 3, particles=100)
    actions = repeated((0.0, -0.5, 0.0), 2).clone().requires_grad_()
    (block.rollout(actions).final.particles.x.sum() * torch.nan).backward()
    assert actions.grad is not None
    assert actions.grad.isnan().any()


# -- hard contact ------------------------------------------------------------------------------------------


def errors_of_directions(folder: Path, softness: float) -> list[float]:
    """Relative errors of derivatives along random directions: how the loss changes over a hundredth of an action.

    Rolling pin, four steps, small random actions, dough that should become flatter.
    """
    task = {"dtype": "float64", "sweeps": 6, "particles": 6000}
    aim = target_of(load_scene("rolling_pin", settings=task), folder, stretch=(1.1, 0.8, 1.1))
    made = load_scene("rolling_pin", settings={**task, "target": aim})

    def loss(actions: torch.Tensor) -> torch.Tensor:
        return made.rollout(actions, softness=softness).losses.sum()

    base = torch.rand(4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    leaf = base.clone().requires_grad_()
    loss(leaf).backward()
    assert leaf.grad is not None
    errors = []
    for seed in range(3):
        direction = torch.randn(
            base.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        exact, h = float((leaf.grad * direction).sum()), 1e-2
        with torch.no_grad():
            found = float(loss(base + h * direction) - loss(base - h * direction)) / (2 * h)
        errors.append(abs(found - exact) / abs(found))
    return sorted(errors)


def test_hard_contact_has_the_wrong_gradient_and_soft_contact_the_right_one(tmp_path: Path) -> None:
    """A node that a tool reaches changes its velocity at once; no derivative sees that before it happens.

    Both are exact derivatives of what is computed. Soft contact makes most of the jump a slope.
    """
    soft, hard = (errors_of_directions(tmp_path, softness) for softness in (666.0, 0.0))
    assert soft[1] < 0.05
    assert hard[1] > 0.2


# -- devices -----------------------------------------------------------------------------------------------


def test_a_device_that_is_not_there_is_named() -> None:
    with pytest.raises(RPGError, match="device"):
        scene(device="cuda")
    with pytest.raises(RPGError, match="device='tpu': choose cpu or cuda"):
        scene(device="tpu")
    block = scene(particles=10)
    with pytest.raises(RPGError, match="runs on the CPU alone"):
        make_backend("numba", block.physics, block.tools, block.mass, block.mass / block.density, "cuda")


def test_two_scenes_of_different_kinds_do_not_disturb_each_other() -> None:
    """One process, two dtypes, two grids, one backend's kernels."""
    kinds: list[dict[str, Any]] = [{"dtype": "float32"}, {"dtype": "float64", "grid": GRID // 2}]
    alone = [idle(scene(**kind), 4)[-1].particles.x for kind in kinds]
    blocks = [scene(**kind) for kind in kinds]
    states = [block.initial_state() for block in blocks]
    for _ in range(4):
        states = [idle(block, 1, state)[0] for block, state in zip(blocks, states, strict=True)]
    for state, wanted in zip(states, alone, strict=True):
        assert torch.equal(state.particles.x, wanted)
