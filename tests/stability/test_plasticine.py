"""Where explicit material points fail: each case is brought about, and the simulator stays sound or stops with an error
that names scene, step and cause.
"""

from __future__ import annotations

import time
from typing import Any

import pytest
import torch
from dough import (
    CELL,
    DT,
    STICKY,
    all_finite,
    idle,
    moving,
    plate,
    repeated,
    run,
    scene,
    sphere,
    strained,
    wander,
)
from record import record

from rpg.errors import NonFiniteError, RPGError
from rpg.plasticine.guard import CFL_LIMIT, sound_speed
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.state import State

TOP = 1 - 3 * CELL  # where positions are clamped


def inside(state: State) -> bool:
    x = state.particles.x.detach()
    return all_finite(state) and float(x.min()) >= 0 and float(x.max()) <= TOP + 1e-6


def falling_block(**settings: Any) -> Scene:
    """It hits a sticky floor within a few steps and is deformed for good."""
    given: dict[str, Any] = {"size": (0.12,) * 3, "centre": (0.5, 0.16, 0.5), "floor_friction": STICKY}
    return scene(**given | settings)


def courant(block: Scene) -> float:
    """Cells that sound crosses in a substep."""
    speed = sound_speed(block.initial_state().material, block.density)
    return speed * block.physics.dt / block.physics.dx


# -- time step and stiffness -------------------------------------------------------------------------------


def test_a_time_step_above_the_stable_limit_is_refused_with_one_that_is_not() -> None:
    with pytest.raises(RPGError) as caught:
        falling_block(dt=5e-4)
    message = str(caught.value)
    assert "dough-v1" in message
    assert "dt=0.0005 is unstable" in message
    stable = float(message.split("take dt=")[1].split()[0])
    assert courant(falling_block(dt=0.99 * stable)) == pytest.approx(CFL_LIMIT, rel=0.02)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_just_below_the_limit_a_hard_landing_stays_bounded(dtype: str) -> None:
    block = falling_block(dt=DT * 0.79 / 0.4768, dtype=dtype, yield_stress=1e6)
    assert 0.78 < courant(block) < CFL_LIMIT
    start = moving(block.initial_state(), torch.tensor([0.0, -3.0, 0.0]))
    for state in idle(block, 40, start):
        assert inside(state)
        assert float(state.particles.v.norm(dim=-1).max()) < 10.0


def test_far_above_the_limit_the_error_names_scene_step_and_cause() -> None:
    block = falling_block(dt=2e-3, unstable=True, yield_stress=1e6)
    start = moving(block.initial_state(), torch.tensor([0.0, -3.0, 0.0]))
    with pytest.raises(NonFiniteError) as caught:
        idle(block, 200, start)
    message = str(caught.value)
    assert "dough-v1: environment step " in message
    assert "particles are not finite" in message
    assert "cells a substep (limit 0.8)" in message
    assert "dt=0.002" in message


def test_stiffness_ramps_up_to_the_limit_and_no_further() -> None:
    """Ten steps at each stiffness, in the same state: from dough to what one substep can still carry."""
    block = falling_block(yield_stress=1e6)
    state = block.initial_state()
    for factor in (0.01, 0.1, 1.0, 2.7):
        state = state._replace(material=block.material(E=5000.0 * factor)[None])
        state = idle(block, 10, state)[-1]
        assert inside(state)
        assert float(state.particles.v.norm(dim=-1).max()) < 10.0
    with pytest.raises(RPGError, match="is unstable"):
        block.material(E=50000.0)
    with pytest.raises(RPGError, match="is unstable"):
        block.initial_state(nu=0.499)


# -- the edge of the grid ----------------------------------------------------------------------------------

WAYS = {
    "wall": (1.0, 0.0, 0.0), "floor": (0.0, -1.0, 0.0), "ceiling": (0.0, 1.0, 0.0), "corner": (-1.0, -1.0, -1.0),
    "far corner": (1.0, 1.0, 1.0),
}  # fmt: skip


def thrown(way: str, speed: float, dtype: str) -> tuple[Scene, list[State]]:
    """A block that flies through the air and hits the edge."""
    block = falling_block(centre=(0.5, 0.5, 0.5), floor_friction=0.3, dtype=dtype)
    return block, idle(block, 12, moving(block.initial_state(), speed * torch.tensor(WAYS[way])))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("way", WAYS)
def test_particles_that_fly_at_the_edge_stay_in_the_grid_and_keep_their_mass(way: str, dtype: str) -> None:
    """At 30, two fifths of the speed of sound."""
    block, states = thrown(way, 30.0, dtype)
    assert all(inside(state) for state in states)
    assert float(block.grid_mass(states[-1]).sum()) == pytest.approx(float(block.mass.sum()), rel=1e-5)


@pytest.mark.parametrize("speed", [300.0, 3000.0])
@pytest.mark.parametrize("way", WAYS)
def test_above_the_speed_of_sound_an_impact_is_survived_or_told(way: str, speed: float) -> None:
    """At 3000 a particle crosses 19 cells in a substep, and the domain in two."""
    try:
        _, states = thrown(way, speed, "float32")
    except NonFiniteError as error:
        assert "dough-v1: environment step" in str(error)
        assert "of 300 particles are not finite, first in substep" in str(error)
    else:
        assert all(inside(state) for state in states)


def test_a_body_that_starts_across_the_walls_comes_to_rest_inside() -> None:
    block = scene(size=(0.15, 0.15, 0.15), centre=(0.075, 0.075, 0.925), floor_friction=0.3)
    state = idle(block, 40)[-1]
    assert inside(state)
    assert float(state.particles.v.norm(dim=-1).mean()) < 1.0


def test_the_gradient_of_a_clamped_coordinate_is_zero_and_the_others_are_finite() -> None:
    block = falling_block(centre=(0.5, 0.5, 0.5), particles=50, substeps=1)
    start = moving(block.initial_state(), torch.tensor([3000.0, 0.0, 0.0]))
    v = start.particles.v.clone().requires_grad_()
    end = block.step(start._replace(particles=start.particles._replace(v=v)), torch.zeros(0))
    assert float(end.particles.x.detach()[..., 0].min()) == pytest.approx(TOP)
    end.particles.x.sum().backward()
    assert v.grad is not None
    assert v.grad[..., 0].abs().max() == 0
    assert v.grad.isfinite().all()
    assert v.grad[..., 1].abs().max() > 0


# -- tools -------------------------------------------------------------------------------------------------


def back_and_forth(scale: float, softness: float) -> list[State]:
    """A sphere through a block, twice."""
    block = scene(sphere(0.2, 0.5, 0.5, scale=scale), centre=(0.5, 0.5, 0.5))
    actions = torch.cat([repeated((1.0, 0.0, 0.0), 6), repeated((-1.0, 0.1, 0.0), 6)])
    return run(block, actions, softness=softness)


@pytest.mark.parametrize("softness", [0.0, 666.0])
def test_a_tool_a_third_as_fast_as_sound_leaves_a_sound_state(softness: float) -> None:
    assert all(inside(state) for state in back_and_forth(0.1, softness))


@pytest.mark.parametrize("softness", [0.0, 666.0])
def test_a_tool_faster_than_sound_leaves_a_sound_state_or_is_named(softness: float) -> None:
    """Nearly a cell in a substep: nodes are reached by no shell, and particles are thrown across the domain."""
    try:
        states = back_and_forth(0.5, softness)
    except NonFiniteError as error:
        assert "the fastest tool 0.8" in str(error)
    else:
        assert all(inside(state) for state in states)


@pytest.mark.parametrize("tool", ["sphere", "plate"])
def test_a_tool_that_starts_inside_a_body_moves_it_without_blowing_it_up(tool: str) -> None:
    centre = (0.5, 0.5, 0.5)
    made = sphere(*centre, radius=0.04) if tool == "sphere" else plate(*centre, half=(0.03, 0.05, 0.04))
    block = scene(made, centre=centre, gravity=[0.0] * 3)
    actions = repeated((0.5, 0.0, 0.0), 10).clone().requires_grad_()
    rollout = block.rollout(actions)
    assert inside(rollout.final)
    assert float(rollout.final.particles.v.detach().norm(dim=-1).max()) < 10.0
    rollout.final.particles.x.mean().backward()
    assert actions.grad is not None
    assert actions.grad.isfinite().all()
    assert float(actions.grad[:, 0].sum()) > 0


def test_two_tools_in_the_same_place_are_no_trouble() -> None:
    """Their normals and velocities disagree at every node that both hold."""
    pair = (sphere(0.48, 0.5, 0.5), sphere(0.52, 0.5, 0.5))
    block = scene(*pair, centre=(0.5, 0.5, 0.5))
    for state in run(block, repeated((1.0, 0.0, 0.0, -1.0, 0.0, 0.0), 10)):
        assert inside(state)


# -- deformation -------------------------------------------------------------------------------------------

STRAINS = {
    "flat": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0),  # singular: det F = 0
    "a line": (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    "a point": (0.0,) * 6,
    "crushed": (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6),
    "torn": (100.0, 0.0, 0.0, 100.0, 0.0, 100.0),
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("yield_stress", [1e6, 50.0])
@pytest.mark.parametrize("strain", STRAINS)
def test_singular_strains_and_their_gradients_are_finite(
    strain: str, yield_stress: float, dtype: str
) -> None:
    """The derivative of a root at 0, of a logarithm below its clamp, of eigenvectors of nothing."""
    block = scene(size=(0.12,) * 3, particles=60, yield_stress=yield_stress, dtype=dtype, substeps=1)
    state = strained(block.initial_state(), torch.tensor(STRAINS[strain]))
    b = state.particles.b.clone().requires_grad_()
    end = block.step(state._replace(particles=state.particles._replace(b=b)), torch.zeros(0))
    assert inside(end)
    (end.particles.x.sum() + end.particles.b.sum()).backward()
    assert b.grad is not None
    assert b.grad.isfinite().all()


@pytest.mark.parametrize("yield_stress", [1e6, 50.0])
@pytest.mark.parametrize("strain", STRAINS)
def test_a_body_of_singular_strain_goes_on_soundly_or_its_end_is_told(
    strain: str, yield_stress: float
) -> None:
    """What is torn to ten times its length, or crushed flat and then set free, is too stiff for the time step."""
    block = scene(size=(0.12,) * 3, particles=60, yield_stress=yield_stress, dtype="float32")
    state = strained(block.initial_state(), torch.tensor(STRAINS[strain]))
    try:
        states = idle(block, 5, state)
    except NonFiniteError as error:
        assert "dough-v1: environment step" in str(error)
        assert "first in substep" in str(error)
    else:
        assert all(inside(state) for state in states)


def test_inversion_in_a_substep_leaves_a_strain_that_is_none() -> None:
    """det(I + dt C) < 0 turns a particle inside out; b = F F^T does not know, and its stress pushes it open again."""
    block = scene(size=(0.12,) * 3, particles=60, gravity=[0.0] * 3, yield_stress=1e6)
    state = block.initial_state()
    C = torch.diag(torch.tensor([-1.5 / DT, 0.0, 0.0], dtype=torch.float64)).expand_as(state.particles.C)
    inverted = state._replace(particles=state.particles._replace(C=C.contiguous()))
    for after in idle(block, 20, inverted):
        assert inside(after)
        b = after.particles.b[0][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))
        assert float(torch.linalg.eigvalsh(b).min()) > -1e-9


# -- material and bodies -----------------------------------------------------------------------------------


def test_without_yield_stress_the_body_flows_and_does_not_fail() -> None:
    block = falling_block()
    solid, liquid = (
        idle(block, 40, block.initial_state(yield_stress=stress))[-1].particles.x for stress in (1e6, 0.0)
    )
    assert liquid.isfinite().all()
    assert float(liquid[..., 1].mean()) < float(solid[..., 1].mean()) - 0.2 * CELL
    assert float(liquid[..., 0].std()) > 1.05 * float(solid[..., 0].std())


def test_an_empty_body_or_scene_is_refused() -> None:
    with pytest.raises(RPGError, match="particles=0 is less than one for each body"):
        scene(particles=0)
    with pytest.raises(RPGError, match="bodies is empty"):
        load_scene({"name": "nothing"})


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_one_particle_falls_lies_and_has_a_gradient(dtype: str) -> None:
    block = scene(sphere(0.5, 0.5, 0.5), particles=1, centre=(0.5, 0.45, 0.5), size=(0.01,) * 3, dtype=dtype)
    actions = repeated((0.0, -0.5, 0.0), 5).clone().requires_grad_()
    end = block.rollout(actions).final
    end.particles.x.sum().backward()
    assert actions.grad is not None
    assert actions.grad.isfinite().all()
    alone = scene(particles=1, centre=(0.5, 0.2, 0.5), size=(0.01,) * 3, dtype=dtype)
    resting = idle(alone, 40)[-1]
    assert inside(resting)
    assert 2 * CELL < float(resting.particles.x[0, 0, 1]) < 3.1 * CELL
    assert abs(float(resting.particles.v[0, 0, 1])) < 0.1


# -- long rollouts -----------------------------------------------------------------------------------------


def test_hundred_steps_of_kneading_stay_sound() -> None:
    block = scene(
        sphere(0.45, 0.2, 0.5, scale=0.02, lower=[0.3, 0.08, 0.3], upper=[0.7, 0.3, 0.7]),
        size=(0.15, 0.12, 0.15), centre=(0.5, 0.12, 0.5), particles=200, dtype="float32",
    )  # fmt: skip
    for state in run(block, wander(3, 100), softness=0.0):
        assert inside(state)
        assert float(state.particles.v.norm(dim=-1).max()) < 30.0
    assert float(block.grid_mass(state).sum()) == pytest.approx(float(block.mass.sum()), rel=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("task", ["move", "rolling_pin", "torus", "rope", "chopsticks", "table"])
def test_a_thousand_steps_of_a_task_stay_sound(task: str) -> None:
    begin = time.perf_counter()
    made = load_scene(task)
    state, sound, fastest = made.initial_state(), True, 0.0
    actions = wander(made.action_dim, 1000)
    with torch.no_grad():
        for action in actions:
            state = made.step(state, action, softness=0.0)
            sound &= all_finite(state)
            fastest = max(fastest, float(state.particles.v.norm(dim=-1).max()))
    slowest_sound = made.physics.dx / made.physics.dt  # a cell in a substep
    passed = sound and fastest < slowest_sound
    record(
        "plasticine_long", 0, {"task": task, "steps": 1000}, "fastest_particle", fastest, passed,
        time.perf_counter() - begin,
    )  # fmt: skip
    assert passed
