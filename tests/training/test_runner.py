from __future__ import annotations

import os
import signal
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from torch import Tensor

from rpg.agents import Agent
from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs
from rpg.errors import NonFiniteError, RPGError
from rpg.training.runner import Episode, Runner, evaluate, summarize


class Clock(gym.Env[np.ndarray, np.ndarray]):
    """Observes (what its seed drew, step of the episode); pays the step's number; ends after ``length`` steps."""

    def __init__(self, length: int, terminates: bool = False, success_at: int | None = None) -> None:
        self.observation_space = Box(0, 1e6, (2,), np.float32)
        self.action_space = Box(-1, 1, (1,), np.float32)
        self.length, self.terminates, self.success_at = length, terminates, success_at

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.drawn, self.t = self.np_random.integers(1_000_000), 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.t += 1
        over = self.t == self.length
        info = {} if self.success_at is None else {"success": self.t == self.success_at}
        return self.observe(), self.reward(), over and self.terminates, over and not self.terminates, info

    def observe(self) -> np.ndarray:
        return np.array([self.drawn, self.t], dtype=np.float32)

    def reward(self) -> float:
        return float(self.t)


class Still(Agent):
    """Never moves; z is how many have been drawn, plus noise."""

    latent_dim = 1
    drawn = 0

    def sample_latent(self, obs: Tensor) -> Tensor:
        self.drawn += 1
        return self.drawn + 0.1 * torch.rand(len(obs), 1)

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        return torch.zeros(len(obs), 1) if deterministic else torch.rand(len(obs), 1)


def batch_of(*envs: Callable[[], gym.Env[Any, Any]]) -> SyncVectorEnv:
    return SyncVectorEnv(envs, autoreset_mode=AutoresetMode.DISABLED)


def still(envs: Any) -> Still:
    return Still(envs.single_observation_space, envs.single_action_space)


def started(*envs: Callable[[], gym.Env[Any, Any]], seed: int = 0) -> Runner:
    batch = batch_of(*envs)
    runner = Runner(still(batch), batch, seed, "clock")
    runner.reset()
    return runner


def first_draws(runner: Runner, steps: int) -> list[list[float]]:
    """For each environment, what the seeds of its episodes drew."""
    draws = [[float(row[0])] for row in runner.observations]
    for _ in range(steps):
        transition, _ = runner.step()
        for i in np.flatnonzero(transition.terminated | transition.truncated):
            draws[i].append(float(runner.observations[i, 0]))
    return draws


# -- stepping ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("terminates", [True, False])
def test_the_true_last_observation_is_kept_and_the_next_episode_begun(terminates: bool) -> None:
    runner = started(lambda: Clock(3, terminates), lambda: Clock(5))
    transitions = [runner.step()[0] for _ in range(4)]
    assert [t.obs[0, 1] for t in transitions] == [0, 1, 2, 0]
    assert [t.next_obs[0, 1] for t in transitions] == [1, 2, 3, 1]
    assert [bool(t.terminated[0]) for t in transitions] == [False, False, terminates, False]
    assert [bool(t.truncated[0]) for t in transitions] == [False, False, not terminates, False]
    assert [t.next_obs[1, 1] for t in transitions] == [1, 2, 3, 4]  # its neighbour goes on
    first, last, new = transitions[0].obs[0, 0], transitions[2].next_obs[0, 0], transitions[3].obs[0, 0]
    assert first == last != new


def test_z_lasts_for_an_episode() -> None:
    runner = started(lambda: Clock(2), lambda: Clock(3))
    z = torch.cat([runner.step()[0].latent for _ in range(4)], dim=1).floor()
    assert z.tolist() == [[1, 1, 2, 2], [1, 1, 1, 3]]


def test_finished_episodes_are_summed_up() -> None:
    runner = started(lambda: Clock(3), lambda: Clock(2))
    finished = [runner.step()[1] for _ in range(4)]
    long, short = Episode(6.0, 3, False, False), Episode(3.0, 2, False, False)
    assert finished == [[], [short], [long], [short]]


@pytest.mark.parametrize(
    ("success_at", "at_end", "ever"),
    [(2, False, True), (3, True, True), (7, False, False), (None, False, False)],
)
def test_success_is_judged_at_the_end_and_at_any_time(
    success_at: int | None, at_end: bool, ever: bool
) -> None:
    runner = started(lambda: Clock(3, success_at=success_at), lambda: Clock(9))
    for _ in range(2):  # the second episode starts with a clean slate
        episode = [runner.step()[1] for _ in range(3)][-1][0]
        assert (episode.success_end, episode.success_ever) == (at_end, ever)
        assert episode.solved_after == (success_at if ever else None)


def test_success_of_one_episode_is_not_carried_into_the_next() -> None:
    class Once(Clock):
        lucky = True

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            *rest, _ = super().step(action)
            lucky, type(self).lucky = type(self).lucky, False
            return (*rest, {"is_success": lucky})  # type: ignore[return-value]

    runner = started(lambda: Once(2))
    episodes = [e for _ in range(4) for e in runner.step()[1]]
    assert [e.success_ever for e in episodes] == [True, False]


def test_summary_is_the_mean_of_every_column() -> None:
    episodes = [Episode(1.0, 10, True, True), Episode(4.0, 20, False, True)]
    assert summarize(episodes, "eval") == {
        "eval/return": 2.5,
        "eval/length": 15.0,
        "eval/success_end": 0.5,
        "eval/success_ever": 1.0,
    }
    assert summarize([], "eval") == {}


def test_a_task_with_a_score_of_its_own_has_it_summed_up() -> None:
    class Judged(Clock):
        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            *rest, _ = super().step(action)
            return (*rest, {"score": 0.1 * float(rest[1])})  # type: ignore[return-value]

    runner = started(lambda: Judged(2))
    episodes = [e for _ in range(2) for e in runner.step()[1]]
    assert summarize(episodes, "train")["train/score"] == pytest.approx(0.2)


def test_environments_that_reset_themselves_are_refused() -> None:
    envs = SyncVectorEnv([lambda: Clock(3)], autoreset_mode=AutoresetMode.NEXT_STEP)
    with pytest.raises(RPGError, match="clock: autoreset mode"):
        Runner(still(envs), envs, 0, "clock")


# -- seeds ---------------------------------------------------------------------------------------------


def test_episodes_come_from_reproducible_seeds_of_their_own() -> None:
    lengths = (lambda: Clock(2), lambda: Clock(3))
    draws = first_draws(started(*lengths, seed=5), 12)
    assert draws == first_draws(started(*lengths, seed=5), 12)
    every = [d for env in draws for d in env]
    assert len(set(every)) == len(every) == 7 + 5
    assert set(every).isdisjoint(d for env in first_draws(started(*lengths, seed=6), 12) for d in env)


def test_seeds_do_not_depend_on_how_long_others_play() -> None:
    alone = first_draws(started(lambda: Clock(2), lambda: Clock(2)), 8)
    beside = first_draws(started(lambda: Clock(2), lambda: Clock(7)), 8)
    assert alone[0] == beside[0]


def test_environments_that_cannot_be_restored_go_on_with_the_next_seeds() -> None:
    lengths = (lambda: Clock(3), lambda: Clock(4))
    straight = first_draws(started(*lengths), 12)
    runner = started(*lengths)
    for _ in range(4):  # the first is one step into its second episode, the second about to begin its own
        runner.step()
    state = runner.state_dict()
    assert state["env"] is None
    envs = batch_of(*lengths)
    resumed = Runner(still(envs), envs, 0, "clock")
    assert resumed.load_state_dict(state) is False
    assert resumed.at_boundary
    assert resumed.observations[:, 1].tolist() == [0, 0]
    assert resumed.observations[:, 0].tolist() == [straight[0][2], straight[1][1]]
    assert [e.length for _ in range(3) for e in resumed.step()[1]] == [
        3
    ]  # nothing of the lost episode counts


def test_environments_that_can_be_restored_go_on_in_mid_episode() -> None:
    config = EnvConfig(id="rpg/GapMaze-v1", kwargs={"episode_steps": 6, "goal": [0.0, 0.0]}, num_envs=2)

    class Wanderer(Agent):
        def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
            return 2 * torch.rand(len(obs), 2) - 1

    def make() -> Runner:
        envs = make_envs(config)
        return Runner(Wanderer(envs.single_observation_space, envs.single_action_space), envs, 0, "maze")

    torch.manual_seed(0)
    straight, resumed = make(), make()
    straight.reset()
    for _ in range(10):
        straight.step()
    state, rng = straight.state_dict(), torch.get_rng_state()
    tail = [straight.step() for _ in range(10)]
    torch.set_rng_state(rng)
    assert resumed.load_state_dict(state) is True
    for transition, episodes in tail:
        again, same_episodes = resumed.step()
        assert all(np.array_equal(a, b) for a, b in zip(transition, again, strict=True))
        assert episodes == same_episodes


# -- bad numbers ---------------------------------------------------------------------------------------


class BadObservation(Clock):
    def observe(self) -> np.ndarray:
        return np.array([self.drawn, np.nan if self.t == 2 else self.t], dtype=np.float32)


class BadReward(Clock):
    def reward(self) -> float:
        return np.inf if self.t == 2 else 0.0


@pytest.mark.parametrize(("env", "what"), [(BadObservation, "observation"), (BadReward, "reward")])
def test_non_finite_numbers_name_environment_step_and_seed(env: type[Clock], what: str) -> None:
    runner = started(lambda: Clock(9), lambda: env(9), seed=5)
    runner.step()
    pattern = f"^clock: {what} .* of environment 1 is not finite .*step 2, episode 1, seed 5"
    with pytest.raises(NonFiniteError, match=pattern) as caught:
        runner.step()
    assert "\n" not in str(caught.value)


def test_non_finite_actions_never_reach_the_environment() -> None:
    class Lost(Still):
        def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
            return torch.tensor([[0.0], [0.0 if obs[1, 1] == 0 else torch.nan]])

    envs = batch_of(lambda: Clock(9), lambda: Clock(9))
    runner = Runner(Lost(envs.single_observation_space, envs.single_action_space), envs, 5, "clock")
    runner.reset()
    runner.step()
    with pytest.raises(NonFiniteError, match=r"^clock: action \[nan\] of environment 1 .*episode 1, seed 5"):
        runner.step()
    assert [env.t for env in envs.envs] == [1, 1]  # type: ignore[attr-defined]


def test_a_non_finite_first_observation_is_caught_too() -> None:
    class Born(Clock):
        def observe(self) -> np.ndarray:
            return np.array([np.inf, 0], dtype=np.float32)

    with pytest.raises(NonFiniteError, match="observation .* of environment 0"):
        started(lambda: Born(3))


# -- evaluation ----------------------------------------------------------------------------------------


class Paying(Clock):
    """Pays its action, so that returns show what was done."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        obs, _, terminated, truncated, info = super().step(action)
        return obs, float(action[0]) + float(self.drawn), terminated, truncated, info


def test_evaluation_is_reproducible_and_leaves_random_state_alone() -> None:
    envs = batch_of(lambda: Paying(3), lambda: Paying(4))
    agent = still(envs)
    torch.manual_seed(0)
    np.random.seed(0)
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].tolist()  # type: ignore[index,union-attr]
    first = evaluate(agent, envs, 6, seed=3, deterministic=False)
    assert torch.equal(torch.get_rng_state(), before)
    assert np.random.get_state()[1].tolist() == numpy_before  # type: ignore[index,union-attr]
    torch.rand(5)
    assert evaluate(agent, envs, 6, seed=3, deterministic=False) == first
    assert evaluate(agent, envs, 6, seed=4, deterministic=False) != first


def test_deterministic_evaluation_takes_modes() -> None:
    envs = batch_of(lambda: Paying(1))
    drawn = [float(e.ret) for e in evaluate(still(envs), envs, 5, seed=0, deterministic=True)]
    assert all(value == int(value) for value in drawn)  # the modes are 0, the rest is whole numbers


@pytest.mark.parametrize(("episodes", "each"), [(6, 3), (5, 3), (1, 1)])
def test_every_environment_contributes_the_same_number_of_episodes(episodes: int, each: int) -> None:
    envs = batch_of(lambda: Clock(1), lambda: Clock(10))
    lengths = [e.length for e in evaluate(still(envs), envs, episodes, seed=0, deterministic=True)]
    assert sorted(lengths) == [1] * each + [10] * each


def test_evaluation_starts_afresh_whatever_was_played_before() -> None:
    envs = batch_of(lambda: Paying(3), lambda: Paying(4))
    agent = still(envs)
    first = evaluate(agent, envs, 4, seed=0, deterministic=True)
    envs.step(np.zeros((2, 1), np.float32))
    assert evaluate(agent, envs, 4, seed=0, deterministic=True) == first


class Deadly(Clock):
    """Its process is killed at step 3 of the episode, if it is the second environment."""

    def __init__(self, deadly: bool) -> None:
        super().__init__(length=5)
        self.deadly = deadly

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self.deadly and self.t == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


def test_a_dead_worker_is_named_with_its_episode() -> None:
    envs = AsyncVectorEnv(
        [partial(Deadly, deadly) for deadly in (False, True)], autoreset_mode=AutoresetMode.DISABLED
    )
    agent = Still(envs.single_observation_space, envs.single_action_space)
    runner = Runner(agent, envs, seed=3, name="clock")
    runner.reset()
    for _ in range(2):
        runner.step()
    message = (
        r"clock: a worker process died: environment 1 \(exit code -9\) after step 2 of episode 1, seed \d+;"
    )
    with pytest.raises(RPGError, match=message):
        runner.step()
    assert envs.closed
