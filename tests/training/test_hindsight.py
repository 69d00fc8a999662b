from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch

from rpg.agents import HindsightConfig
from rpg.errors import RPGError
from rpg.goals import GoalSpec
from rpg.segments import SegmentBatch
from rpg.training.hindsight import HindsightReplay

ENVS, WINDOW = 3, 4
# The state says which environment, episode and step it is, and all of it is what was achieved.
SPEC = GoalSpec(state_dim=3, achieved=(0, 1, 2), relabel_radius=0.5, success_radius=0.5)
NOWHERE = -5.0


class Recorder:
    """Plays episodes of random length (1 to 9) and keeps, beside the replay, what happened."""

    def __init__(self, capacity: int = 3000, seed: int = 0, **settings: Any) -> None:
        self.config = HindsightConfig(**{"ratio": 1.0, "window": WINDOW} | settings)
        self.replay = HindsightReplay(SPEC, self.config, 6, 1, 0, ENVS, capacity)
        self.rng = np.random.default_rng(seed)
        self.episode = np.zeros(ENVS, dtype=int)
        self.step = np.zeros(ENVS, dtype=int)
        self.length = self.rng.integers(1, 10, ENVS)
        self.rows: list[np.ndarray] = []  # (ENVS, 2) episode and step of every vector step
        self.steps: dict[tuple[int, int], int] = {}  # (env, episode) -> steps so far

    def play(self, vector_steps: int) -> Recorder:
        env = np.arange(ENVS)
        goal = np.full((ENVS, 3), NOWHERE)
        for _ in range(vector_steps):
            ended = self.step + 1 == self.length
            before = np.stack([env, self.episode, self.step], axis=1)
            after = before + np.array([0, 0, 1])
            terminated = ended & (self.rng.random(ENVS) < 0.5)
            self.replay.add(
                np.concatenate([before, goal], axis=1),
                np.zeros((ENVS, 1)),
                np.full(ENVS, 7.0),
                np.concatenate([after, goal], axis=1),
                terminated,
                ended & ~terminated,
                torch.zeros(ENVS, 0),
            )
            self.rows.append(before[:, 1:])
            for i in env:
                self.steps[i, self.episode[i]] = self.step[i] + 1
            self.step = np.where(ended, 0, self.step + 1)
            self.episode += ended
            self.length = np.where(ended, self.rng.integers(1, 10, ENVS), self.length)
        return self

    def cut(self) -> Recorder:
        """The environments are lost; all begin anew."""
        self.replay.cut()
        self.episode += self.step > 0
        self.step[:] = 0
        return self

    def through_a_file(self, capacity: int = 3000) -> Recorder:
        file = io.BytesIO()
        torch.save(self.replay.state_dict(), file)
        file.seek(0)
        self.replay = HindsightReplay(SPEC, self.config, 6, 1, 0, ENVS, capacity)
        self.replay.load_state_dict(torch.load(file, weights_only=True))
        return self

    def future(self, age: int, env: int, u: float) -> tuple[float, float, float]:
        """The goal by the book: that of t + 1 + floor(u * (min(T, t + W) - t))."""
        stored = self.rows[-len(self.replay) // ENVS :]
        episode, t = stored[age][env]
        last = min(self.steps[env, episode], t + WINDOW)
        return env, episode, t + 1 + int(np.floor(u * (last - t)))


def histories() -> dict[str, Recorder]:
    return {
        "running": Recorder().play(5),
        "long": Recorder(seed=1).play(200),
        "wrapped around": Recorder(30 * ENVS, seed=2).play(100),
        "shorter than an episode": Recorder(3 * ENVS, seed=3).play(50),
        "cut": Recorder(seed=4).play(23).cut().play(7),
        "cut twice": Recorder(seed=4).play(5).cut().cut().play(2),
        "stored": Recorder(30 * ENVS, seed=5).play(77).through_a_file(),
        "stored and wrapped around": Recorder(30 * ENVS, seed=6).play(44).through_a_file(30 * ENVS).play(50),
        "stored before a cut": Recorder(30 * ENVS, seed=7)
        .play(44)
        .through_a_file(9 * ENVS * 5)
        .cut()
        .play(3),
    }


HISTORIES = histories()


@pytest.mark.parametrize("name", HISTORIES)
def test_goals_are_those_of_an_episode_rewritten_by_hand(name: str) -> None:
    history = HISTORIES[name]
    count = len(history.replay) // ENVS
    for age in range(count):
        for env in range(ENVS):
            for u in (0.0, 0.24, 0.26, 0.6, 0.99999, 1.0 - 2.0**-24):
                found = history.replay._future(torch.tensor([age]), torch.tensor([env]), torch.tensor([u]))
                assert tuple(found[0].tolist()) == history.future(age, env, u), (age, env, u)


@pytest.mark.parametrize("name", HISTORIES)
def test_a_batch_is_what_happened_with_other_goals(name: str) -> None:
    history = HISTORIES[name]
    torch.manual_seed(0)
    batch = history.replay.sample(500, 1)
    env, episode, t = batch.obs[:, 0], batch.obs[:, 1], batch.obs[:, 2]
    goal = batch.obs[:, 3:]
    assert torch.equal(batch.next_obs[0, :, 3:], goal)
    assert torch.equal(goal[:, 0], env)
    assert torch.equal(goal[:, 1], episode)
    ahead = goal[:, 2] - t
    assert ahead.min() >= 1
    assert ahead.max() <= WINDOW
    assert torch.equal(batch.next_obs[0, :, 2], t + 1)
    assert torch.equal(batch.reward[0], torch.where(ahead == 1, 0.0, -1.0))


def test_every_step_within_reach_is_as_likely() -> None:
    torch.manual_seed(0)
    history = Recorder(seed=8).play(60)
    batch = history.replay.sample(40_000, 1)
    left = torch.tensor([history.steps[int(e), int(k)] - int(t) for e, k, t in batch.obs[:, :3]])
    for reach in range(1, WINDOW + 1):
        rows = left == reach if reach < WINDOW else left >= WINDOW
        ahead = (batch.obs[rows, 5] - batch.obs[rows, 2]).long()
        share = torch.bincount(ahead, minlength=reach + 1)[1:] / rows.sum()
        assert len(share) == reach
        torch.testing.assert_close(share, torch.full((reach,), 1 / reach), atol=0.03, rtol=0)


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.8, 1.0])
def test_the_coin_has_the_probability_that_was_asked_for(ratio: float) -> None:
    torch.manual_seed(0)
    batch = Recorder(ratio=ratio).play(50).replay.sample(20_000, 1)
    relabelled = (batch.obs[:, 3] != NOWHERE).double().mean()
    assert abs(float(relabelled) - ratio) <= 5 * (ratio * (1 - ratio) / 20_000) ** 0.5
    kept = batch.obs[:, 3] == NOWHERE
    assert (batch.reward[0, kept] == -1).all()  # recomputed: the environment said 7


def test_a_segment_has_one_goal_and_its_rewards() -> None:
    torch.manual_seed(0)
    batch: SegmentBatch = Recorder().play(100).replay.sample(300, 3)
    goal = batch.obs[:, 3:]
    for k in range(3):
        assert torch.equal(batch.next_obs[k, :, 3:], goal)
        arrived = (batch.next_obs[k, :, :3] == goal).all(-1)
        assert torch.equal(batch.reward[k], arrived.float() - 1)
    assert 0 < (batch.reward[1] == 0).float().mean() < 1


def test_dense_rewards_are_distances_with_an_end() -> None:
    torch.manual_seed(0)
    batch = Recorder(reward="dense", dense_scale=0.4).play(100).replay.sample(300, 1)
    ahead = batch.obs[:, 5] - batch.obs[:, 2]  # 1 to 4, of which the step itself makes 1
    torch.testing.assert_close(batch.reward[0], -(0.4 * (ahead - 1)).clamp(max=1.0))


def test_arrival_is_within_the_radius() -> None:
    spec = GoalSpec(state_dim=1, achieved=(0,), relabel_radius=0.5, success_radius=9.0)
    replay = HindsightReplay(spec, HindsightConfig(ratio=0.0), 2, 1, 0, 4, 100)
    goal = np.array([0.0, 0.49, 0.51, 3.0])
    obs = np.stack([np.zeros(4), goal], axis=1)
    replay.add(obs, np.zeros((4, 1)), np.zeros(4), obs, np.zeros(4), np.zeros(4), torch.zeros(4, 0))
    batch = replay.sample(200, 1)
    assert torch.equal(batch.reward[0], torch.where(batch.obs[:, 1] < 0.5, 0.0, -1.0))


def test_what_is_stored_stays_as_it_happened() -> None:
    history = Recorder().play(40)
    before = history.replay.state_dict()["data"].clone()
    history.replay.sample(100, 2)
    assert torch.equal(history.replay.state_dict()["data"], before)
    assert (history.replay.observations(50)[:, 3:] == NOWHERE).all()


@pytest.mark.parametrize(
    "settings",
    [{"ratio": 1.1}, {"ratio": float("nan")}, {"window": 0}, {"reward": "x"}, {"dense_scale": 0.0}],
)
def test_what_is_impossible_is_refused_in_one_line(settings: dict[str, Any]) -> None:
    with pytest.raises(RPGError, match="agent.hindsight") as caught:
        HindsightConfig(**settings)
    assert "\n" not in str(caught.value)
