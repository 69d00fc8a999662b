"""The planner, in models whose best action is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.world_model.mppi import PlannerConfig, PlanNoise, plan

CONFIG = PlannerConfig(samples=64, elites=8, iterations=4, temperature=5.0)
H = 3


class Line:
    """s' = s + 0.2 a on a line; ``reward`` and ``value`` are given functions of (state, action)."""

    def __init__(
        self,
        reward: Callable[[Tensor, Tensor], Tensor] = lambda s, a: 0 * s,
        value: Callable[[Tensor, Tensor], Tensor] = lambda s, a: 0 * s,
    ) -> None:
        self._reward, self._value = reward, value

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return state + 0.2 * action, self._reward(state, action)[..., 0]

    def q_value(self, state: Tensor, action: Tensor) -> Tensor:
        value = self._value(state, action)[..., 0]
        return torch.stack([value, value + 1.0])


class Always:
    """A policy of one action."""

    def __init__(self, action: float) -> None:
        self._action = action

    def __call__(self, state: Tensor) -> Tensor:
        return torch.full_like(state, self._action)

    def sample(self, state: Tensor, noise: Tensor) -> Tensor:
        return self(state)


def search(
    model: Line,
    state: Tensor,
    policy: Always | None = None,
    horizon: int = H,
    mean: Tensor | None = None,
    config: PlannerConfig = CONFIG,
    greedy: bool = True,
    min_std: float = 0.05,
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    torch.manual_seed(seed)
    noise = PlanNoise.draw(config, len(state), H, 1, torch.device("cpu"), greedy)
    mean = torch.zeros(len(state), H, 1) if mean is None else mean
    return plan(
        model,
        policy or Always(0.0),
        state,
        mean,
        torch.tensor(horizon),
        torch.tensor(min_std),
        0.9,
        config,
        noise,
    )


@pytest.mark.parametrize("best", [-0.6, 0.3])
def test_finds_the_action_with_the_highest_reward(best: float) -> None:
    thorough = PlannerConfig(samples=256, elites=32)
    model = Line(reward=lambda s, a: -10 * (a - best).square())
    action, mean = search(model, torch.zeros(5, 1), config=thorough, min_std=0.01)
    torch.testing.assert_close(action, torch.full((5, 1), best), atol=0.03, rtol=0)
    torch.testing.assert_close(mean, torch.full((5, H, 1), best), atol=0.03, rtol=0)


def test_looks_beyond_the_first_step() -> None:
    # To the right the first reward is lower, but what follows makes up for it.
    def reward(state: Tensor, action: Tensor) -> Tensor:
        return torch.where(state > 0.1, 10.0, -action)

    assert (search(Line(reward), torch.zeros(4, 1))[0] > 0.3).all()
    assert (search(Line(reward), torch.zeros(4, 1), horizon=1)[0] < -0.3).all()


def test_the_value_at_the_horizon_counts() -> None:
    model = Line(value=lambda s, a: 50 * s)
    for horizon in (1, H):
        assert (search(model, torch.zeros(4, 1), horizon=horizon)[0] > 0.8).all()


def test_the_value_is_that_of_what_the_policy_would_do_there() -> None:
    # What the critics say of other actions must not matter.
    model = Line(reward=lambda s, a: -(a - 0.5).square(), value=lambda s, a: 100 * s * a)
    assert (search(model, torch.zeros(4, 1), Always(1.0))[0] > 0.8).all()
    assert (search(model, torch.zeros(4, 1), Always(-1.0))[0] < -0.8).all()


def test_only_the_steps_of_the_horizon_are_planned() -> None:
    _, mean = search(Line(reward=lambda s, a: a), torch.zeros(4, 1), horizon=2, mean=torch.ones(4, H, 1))
    assert not mean[:, 2].any()
    assert mean[:, :2].all()


def test_environments_do_not_see_each_other() -> None:
    model = Line(reward=lambda s, a: -10 * (a - s).square())
    state = torch.tensor([[-0.5], [0.0], [0.5]])
    other = state.clone()
    other[1:] = 9.0
    first, mean = search(model, state)
    again, other_mean = search(model, other)
    assert torch.equal(first[0], again[0])
    assert torch.equal(mean[0], other_mean[0])
    assert not torch.equal(first[1], again[1])
    torch.testing.assert_close(first, state, atol=0.15, rtol=0)  # each found its own


def test_a_rare_good_action_is_found_where_the_policy_proposes_it() -> None:
    model = Line(reward=lambda s, a: 100.0 * ((a - 0.77).abs() < 1e-4).float())
    torch.testing.assert_close(search(model, torch.zeros(4, 1), Always(0.77))[0], torch.full((4, 1), 0.77))
    blind = replace(CONFIG, policy_share=0.0)
    assert ((search(model, torch.zeros(4, 1), Always(0.77), config=blind)[0] - 0.77).abs() > 1e-3).any()


def test_a_search_goes_on_from_the_mean_it_is_given() -> None:
    quick = replace(CONFIG, samples=8, elites=8, iterations=1, momentum=0.9, policy_share=0.0)
    _, cold = search(Line(), torch.zeros(200, 1), config=quick)
    _, warm = search(Line(), torch.zeros(200, 1), config=quick, mean=torch.full((200, H, 1), 0.8))
    assert float((warm - cold).mean()) > 0.7


def test_noise_is_added_unless_greedy_and_stays_within_bounds() -> None:
    model = Line(reward=lambda s, a: -100 * a.square())
    still, _ = search(model, torch.zeros(200, 1), min_std=0.5)
    noisy, _ = search(model, torch.zeros(200, 1), min_std=0.5, greedy=False)
    assert float(still.std()) < 0.2 < float(noisy.std())
    assert float(noisy.abs().max()) <= 1.0


def test_what_is_not_finite_is_the_worst() -> None:
    def reward(state: Tensor, action: Tensor) -> Tensor:
        return torch.where(action > 0, torch.where(action > 0.5, float("inf"), float("nan")), action)

    action, mean = search(Line(reward), torch.zeros(4, 1))
    assert (action <= 0).all()
    assert mean.isfinite().all()


@pytest.mark.parametrize(
    "bad",
    [
        {"elites": 600},
        {"elites": 0},
        {"iterations": 0},
        {"policy_share": 1.5},
        {"momentum": 1.0},
        {"temperature": float("nan")},
        {"min_std": 0.0},
    ],
)
def test_impossible_settings_are_refused_in_one_line(bad: dict[str, float]) -> None:
    with pytest.raises(RPGError, match=r"^agent\.planner: ") as caught:
        replace(PlannerConfig(), **bad)
    assert "\n" not in str(caught.value)
