from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from rpg.errors import RPGError
from rpg.segments import SegmentBatch
from rpg.training.replay import SegmentReplay, Shares

ENVS = 3
HORIZON = 4


class Recorder:
    """Plays episodes of random length (1 to 9) whose every number says which environment, episode and step it is."""

    def __init__(self, replay: SegmentReplay, seed: int = 0) -> None:
        self.replay = replay
        self.rng = np.random.default_rng(seed)
        self.episode = np.zeros(ENVS, dtype=int)
        self.step = np.zeros(ENVS, dtype=int)
        self.length = self.rng.integers(1, 10, ENVS)
        self.recorded: dict[tuple[int, int], int] = {}  # (env, episode) -> steps recorded
        self.terminated: dict[tuple[int, int], bool] = {}  # of finished episodes

    def play(self, vector_steps: int) -> None:
        env = np.arange(ENVS)
        for _ in range(vector_steps):
            ended = self.step + 1 == self.length
            terminated = ended & (self.rng.random(ENVS) < 0.5)
            where = np.stack([env, self.episode, self.step], axis=1)
            self.replay.add(
                obs=where.astype(np.float32),
                action=torch.from_numpy(where[:, 2:] * 10.0),
                reward=where[:, 2] * 100.0,
                next_obs=where + np.array([0, 0, 1]),
                terminated=terminated,
                truncated=ended & ~terminated,
                latent=torch.from_numpy(where[:, :2] * 1.0),
            )
            for i in env:
                self.recorded[i, self.episode[i]] = self.step[i] + 1
                if ended[i]:
                    self.terminated[i, self.episode[i]] = bool(terminated[i])
            self.step = np.where(ended, 0, self.step + 1)
            self.episode += ended
            self.length = np.where(ended, self.rng.integers(1, 10, ENVS), self.length)

    def cut(self) -> None:
        """The environments are lost; all begin anew."""
        self.replay.cut()
        running = self.step > 0
        for i in np.flatnonzero(running):
            self.terminated[i, self.episode[i]] = False
        self.episode += running
        self.step[:] = 0


def make(capacity: int = 600, prioritized: bool = False) -> SegmentReplay:
    return SegmentReplay(
        obs_dim=3, action_dim=1, latent_dim=2, num_envs=ENVS, capacity=capacity, prioritized=prioritized
    )


def segments(batch: SegmentBatch) -> Iterator[dict[str, Any]]:
    """One dict of numpy arrays for each segment."""
    for i in range(len(batch.obs)):
        yield {
            "obs": batch.obs[i].numpy(),
            "latent": batch.latent[i].numpy(),
            "step": float(batch.step[i]),
            **{
                k: getattr(batch, k)[:, i].numpy()
                for k in ("next_obs", "action", "reward", "terminated", "mask")
            },
        }


def check(recorder: Recorder, batch: SegmentBatch) -> None:
    """Every segment shows consecutive steps of one episode, as many as were recorded."""
    for s in segments(batch):
        env, episode, step = s["obs"].astype(int)
        recorded = recorder.recorded[env, episode]
        valid = min(HORIZON, recorded - step)
        assert s["mask"].tolist() == [1.0] * valid + [0.0] * (HORIZON - valid)
        assert s["step"] == step
        assert s["latent"].tolist() == [env, episode]
        ends = recorder.terminated.get((env, episode), False)
        for k in range(HORIZON):
            at = step + min(k, valid - 1)  # masked steps repeat the last valid one
            assert s["next_obs"][k].tolist() == [env, episode, at + 1]
            assert s["action"][k].tolist() == [at * 10]
            assert s["reward"][k] == at * 100
            assert s["terminated"][k] == float(ends and at + 1 == recorded)


@pytest.mark.parametrize("vector_steps", [1, 3, 60, 199, 200, 201, 455])
def test_segments_are_consecutive_steps_of_one_episode(vector_steps: int) -> None:
    recorder = Recorder(make())  # 200 rows: the last ones overwrite, once and twice around
    recorder.play(vector_steps)
    torch.manual_seed(0)
    check(recorder, recorder.replay.sample(1500, HORIZON))


def test_small_ring_keeps_only_the_newest_steps() -> None:
    recorder = Recorder(make(capacity=ENVS * 5 + 2))  # rounded down to 5 rows
    recorder.play(23)
    assert len(recorder.replay) == ENVS * 5
    torch.manual_seed(0)
    batch = recorder.replay.sample(500, HORIZON)
    check(recorder, batch)
    seen = {tuple(row) for row in batch.obs.int().tolist()}
    newest: set[tuple[int, ...]] = set()
    replayed = Recorder(make())
    replayed.play(18)
    older = {(e, ep, st) for (e, ep), n in replayed.recorded.items() for st in range(n)}
    every = {(e, ep, st) for (e, ep), n in recorder.recorded.items() for st in range(n)}
    newest = every - older
    assert seen == {(int(e), int(ep), int(st)) for e, ep, st in newest}


def test_newest_incomplete_segment_is_masked_where_nothing_is_known_yet() -> None:
    recorder = Recorder(make())
    recorder.length[:] = 100
    recorder.play(3)
    batch = recorder.replay.sample(200, HORIZON)
    for s in segments(batch):
        assert s["mask"].sum() == 3 - s["step"]
        assert s["terminated"].sum() == 0


@pytest.mark.parametrize("vector_steps", [40, 110])
def test_sampling_is_uniform_over_transitions(vector_steps: int) -> None:
    recorder = Recorder(make(capacity=ENVS * 50))
    recorder.play(vector_steps)
    torch.manual_seed(0)
    cells = len(recorder.replay)
    draws = 100 * cells
    obs = recorder.replay.sample(draws, 1).obs.int()
    counts = np.unique(obs.numpy(), axis=0, return_counts=True)[1]
    assert len(counts) == cells
    chi_square = ((counts - 100) ** 2 / 100).sum()
    assert abs(chi_square - (cells - 1)) < 5 * np.sqrt(2 * (cells - 1))


def test_cut_ends_running_episodes_without_terminating_them() -> None:
    recorder = Recorder(make())
    recorder.play(50)
    recorder.cut()
    recorder.play(50)
    torch.manual_seed(0)
    check(recorder, recorder.replay.sample(2000, HORIZON))


def test_cut_holds_at_the_seam_of_the_ring() -> None:
    recorder = Recorder(make(capacity=ENVS * 20))
    recorder.play(20)  # the next row to write is the first
    recorder.cut()
    recorder.play(7)
    torch.manual_seed(0)
    check(recorder, recorder.replay.sample(1000, HORIZON))


def test_a_horizon_of_one_and_one_longer_than_everything_work() -> None:
    recorder = Recorder(make())
    recorder.play(6)
    assert recorder.replay.sample(20, 1).mask.tolist() == [[1.0] * 20]
    long = recorder.replay.sample(50, 30)
    assert long.next_obs.shape == (30, 50, 3)
    assert (long.mask.sum(0) <= 6).all()


def test_recent_transitions_can_be_preferred() -> None:
    recorder = Recorder(make())
    recorder.length[:] = 1000
    recorder.play(200)
    torch.manual_seed(0)
    step = recorder.replay.sample(1000, HORIZON, Shares(recent=0.5, recent_window=10 * ENVS)).step
    assert step[:500].min() == 190
    assert step[500:].min() < 20


@pytest.mark.parametrize("vector_steps", [150, 333])  # of 200 rows: before and after the ring went round
def test_novel_transitions_can_be_preferred(vector_steps: int) -> None:
    recorder = Recorder(make(prioritized=True))
    recorder.length[:] = 1000
    recorder.play(vector_steps)
    replay = recorder.replay
    assert replay.priorities is not None
    everything = replay.sample(20_000, HORIZON)
    assert everything.place is not None
    # The environment observes how many steps it took; those whose number ends in 77 are novel.
    novelty = (everything.step % 100 == 77).float()
    replay.priorities.judge(everything.place, novelty)
    step = replay.sample(1000, HORIZON, Shares(recent=0.25, recent_window=10 * ENVS, novel=0.5)).step
    assert set((step[500:] % 100).tolist()) == {77}
    assert (step[250:500] % 100 != 77).float().mean() > 0.9
    assert step[:250].min() == vector_steps - 10


def test_priorities_go_on_after_a_restart() -> None:
    recorder = Recorder(make(prioritized=True))
    recorder.play(333)
    batch = recorder.replay.sample(20_000, 1)  # all of them
    assert batch.place is not None
    assert recorder.replay.priorities is not None
    recorder.replay.priorities.judge(batch.place, (batch.step == 1).float())
    resumed = make(prioritized=True)
    resumed.load_state_dict(through_a_file(recorder.replay.state_dict()))
    assert set(resumed.sample(200, 1, Shares(novel=1.0)).step.tolist()) == {1.0}


def through_a_file(state: dict[str, Any]) -> dict[str, Any]:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize("vector_steps", [30, 200, 333])
def test_continues_equal_from_its_state(vector_steps: int) -> None:
    straight = Recorder(make())
    straight.play(vector_steps)
    resumed = Recorder(make())
    resumed.play(vector_steps)
    resumed.replay = make()
    resumed.replay.load_state_dict(through_a_file(straight.replay.state_dict()))
    for recorder in (straight, resumed):
        recorder.play(20)
        assert len(recorder.replay) == len(straight.replay)
    torch.manual_seed(0)
    a = straight.replay.sample(500, HORIZON)
    torch.manual_seed(0)
    b = resumed.replay.sample(500, HORIZON)
    assert all(torch.equal(x, y) for x, y in zip(a[:8], b[:8], strict=True))  # without bonus and index


def test_state_holds_only_what_is_filled() -> None:
    recorder = Recorder(make())
    recorder.play(7)
    assert recorder.replay.state_dict()["data"].shape[0] == 7


@pytest.mark.parametrize(
    "other",
    [
        SegmentReplay(4, 1, 2, ENVS, 600),
        SegmentReplay(3, 1, 2, ENVS + 1, 600),
        SegmentReplay(3, 1, 2, ENVS, 60),
    ],
    ids=["observation", "environments", "smaller"],
)
def test_state_of_another_shape_is_refused(other: SegmentReplay) -> None:
    recorder = Recorder(make())
    recorder.play(50)
    with pytest.raises(RPGError, match="^replay: "):
        other.load_state_dict(recorder.replay.state_dict())


def test_state_of_a_full_smaller_ring_is_refused_or_read_right() -> None:
    recorder = Recorder(make(capacity=ENVS * 20))
    recorder.play(25)
    bigger = make()
    try:
        bigger.load_state_dict(recorder.replay.state_dict())
    except RPGError:
        return
    recorder.replay = bigger
    check(recorder, bigger.sample(500, HORIZON))


@pytest.mark.parametrize("name", ["obs", "next_obs", "action", "reward", "terminated", "latent"])
@pytest.mark.parametrize("shape", [(ENVS, 9), (ENVS + 1, 1)])
def test_transitions_of_the_wrong_shape_are_refused_and_not_stored(name: str, shape: tuple[int, int]) -> None:
    replay = make()
    good = {
        "obs": np.zeros((ENVS, 3)),
        "action": np.zeros((ENVS, 1)),
        "reward": np.zeros(ENVS),
        "next_obs": np.zeros((ENVS, 3)),
        "terminated": np.zeros(ENVS, bool),
        "truncated": np.zeros(ENVS, bool),
        "latent": torch.zeros(ENVS, 2),
    }
    wrong = torch.zeros(shape) if name == "latent" else np.zeros(shape)
    with pytest.raises(RPGError, match="^replay"):
        replay.add(**(good | {name: wrong}))
    assert len(replay) == 0


def test_nothing_can_be_drawn_from_an_empty_replay() -> None:
    with pytest.raises(RPGError, match="replay is empty"):
        make().sample(4, HORIZON)


def test_too_small_a_capacity_is_refused() -> None:
    with pytest.raises(RPGError, match="replay capacity=5"):
        make(capacity=5)
