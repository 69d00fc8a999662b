"""The layout of observations with goals, on arrays and tensors, and how it is found."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorWrapper

from rpg.attributes import declared
from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs
from rpg.errors import RPGError
from rpg.goals import GoalSpec, goal_spec_of

SPEC = GoalSpec(5, (1, 2), 0.5, 2.0)
PICKED = GoalSpec(5, (4, 0, 3), 0.5, 2.0)


@pytest.mark.parametrize("spec", [SPEC, PICKED])
@pytest.mark.parametrize("shape", [(), (7,), (2, 3)])
def test_parts_come_apart_and_together(spec: GoalSpec, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(*shape, spec.obs_dim)).astype(np.float32)
    state, goal = spec.split(obs)
    assert state.shape == (*shape, 5)
    assert goal.shape == (*shape, spec.goal_dim)
    np.testing.assert_array_equal(spec.join(state, goal), obs)
    achieved = spec.achieved_goal(state)
    expected = np.stack([state[..., i] for i in spec.achieved], axis=-1)
    np.testing.assert_array_equal(achieved, expected)
    near = spec.arrived(achieved, achieved + 0.1)
    assert near.shape == shape
    assert near.all()

    tensor = torch.as_tensor(obs)
    t_state, t_goal = spec.split(tensor)
    np.testing.assert_array_equal(spec.join(t_state, t_goal).numpy(), obs)
    np.testing.assert_array_equal(spec.achieved_goal(t_state).numpy(), achieved)
    np.testing.assert_array_equal(
        spec.arrived(spec.achieved_goal(t_state), t_goal).numpy(), spec.arrived(achieved, goal)
    )


def test_arrival_is_within_the_relabel_radius() -> None:
    goal = np.zeros((4, 2))
    achieved = np.array([(0.5, 0.0), (0.3, 0.4), (0.36, 0.36), (0.0, -0.51)])
    assert SPEC.arrived(achieved, goal).tolist() == [True, True, False, False]
    assert SPEC.arrived(torch.as_tensor(achieved), torch.zeros(4, 2)).tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((5, (), 1.0, 1.0), r"achieved \(\) must be distinct indices of a state of 5"),
        ((5, (5,), 1.0, 1.0), r"achieved \(5,\) must be"),
        ((5, (1, 1), 1.0, 1.0), r"achieved \(1, 1\) must be"),
        ((5, (1,), 0.0, 1.0), "relabel_radius 0.0 and success_radius 1.0 must be positive"),
        ((5, (1,), 1.0, -1.0), "success_radius -1.0 must be positive"),
    ],
)
def test_bad_specs(arguments: Any, message: str) -> None:
    with pytest.raises(RPGError, match=message):
        GoalSpec(*arguments)


def test_observations_of_another_width_are_refused() -> None:
    with pytest.raises(RPGError, match="has 6 entries, expected 5 of the state and 2 of the goal"):
        SPEC.split(np.zeros((3, 6)))


def make_reach() -> gymnasium.Env[Any, Any]:
    return gymnasium.make("rpg/Reach2D-v0")


def test_the_spec_is_found_through_wrappers_and_processes() -> None:
    batch = make_envs(EnvConfig(id="rpg/Reach2D-v0", num_envs=2))
    spec = goal_spec_of(batch)
    assert (spec.state_dim, spec.achieved) == (2, (0, 1))
    assert (spec.relabel_radius, spec.success_radius) == (0.03, 1.0)
    assert goal_spec_of(VectorWrapper(batch)) == spec
    assert goal_spec_of(make_reach()) == spec
    with closing(SyncVectorEnv([make_reach] * 2)) as envs:
        assert goal_spec_of(envs) == spec
        assert goal_spec_of(VectorWrapper(envs)) == spec
    with closing(AsyncVectorEnv([make_reach] * 2)) as apart:
        assert goal_spec_of(apart) == spec
        assert declared(apart, "no_such_thing") is None
        assert goal_spec_of(apart) == spec, "workers outlive a question that they have no answer to"


def test_environments_without_goals_are_named() -> None:
    with pytest.raises(RPGError, match="environment 'Pendulum-v1' has no goals; choose one"):
        goal_spec_of(gymnasium.make("Pendulum-v1"))
    with closing(make_envs(EnvConfig(id="Pendulum-v1", num_envs=2))) as envs:
        assert declared(envs, "goal_spec") is None
        with pytest.raises(RPGError, match="has no goals"):
            goal_spec_of(envs)
