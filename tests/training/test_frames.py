"""Pictures: stored once, stacked by number, learned from by every part."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from rpg.errors import RPGError
from rpg.pixels import FrameShape, PixelTrunk, pixel_encoder
from rpg.training.replay import SegmentReplay

SHAPE = FrameShape(stack=2, height=2, width=2, channels=1)


class Story:
    """Vector steps of two environments whose frames say when and where they were seen; episodes of given lengths."""

    def __init__(self, replay: SegmentReplay, lengths: tuple[int, int] = (3, 4)) -> None:
        self.replay, self.lengths = replay, lengths
        self.time, self.t = 0, [0, 0]
        self.obs = np.stack([np.tile(self.frame(env), 2) for env in range(2)])
        self.seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def frame(self, env: int) -> np.ndarray:
        return np.array([self.time % 250, self.time // 250, env, self.t[env]], dtype=np.uint8)

    def step(self) -> None:
        self.time += 1
        before, after, ended = self.obs, self.obs.copy(), np.zeros(2, np.bool_)
        for env in range(2):
            self.t[env] += 1
            after[env] = np.concatenate([before[env, 4:], self.frame(env)])
            ended[env] = self.t[env] == self.lengths[env]
        reward = np.full(2, self.time, np.float32)
        self.replay.add(before, np.zeros((2, 1)), reward, after, np.zeros(2), ended, torch.zeros(2, 0))
        self.seen[self.time] = (before, after)
        self.obs = after.copy()
        for env in np.flatnonzero(ended):
            self.t[env] = 0
            self.obs[env] = np.tile(self.frame(env), 2)


def check(replay: SegmentReplay, story: Story, samples: int = 400) -> set[int]:
    """Every sampled observation is the one of its time; returns the times met."""
    batch = replay.sample(samples, 3)
    assert batch.obs.dtype == batch.next_obs.dtype == torch.uint8
    for i in range(samples):
        for k in range(int(batch.mask[:, i].sum())):
            env = int(batch.next_obs[k, i, 6])
            before, after = story.seen[int(batch.reward[k, i])]
            assert batch.next_obs[k, i].tolist() == after[env].tolist()
            if k == 0:
                assert batch.obs[i].tolist() == before[env].tolist()
    return {int(time) for time in batch.reward[0]}


def test_observations_come_back_as_they_were() -> None:
    replay = SegmentReplay(SHAPE.size, 1, 0, num_envs=2, capacity=100, frames=SHAPE)
    story = Story(replay)
    for _ in range(30):
        story.step()
    assert check(replay, story) == set(range(1, 31))


@pytest.mark.parametrize("lengths", [(3, 4), (1, 1), (50, 7)])
def test_a_full_ring_never_gives_a_frame_that_was_overwritten(lengths: tuple[int, int]) -> None:
    replay = SegmentReplay(SHAPE.size, 1, 0, num_envs=2, capacity=40, frames=SHAPE)
    story = Story(replay, lengths)
    for _ in range(150):
        story.step()
        if story.time > 20:
            met = check(replay, story, samples=60)
            assert max(met) > story.time - 20
    assert len(replay) >= 40 / 2 - 4, "an episode of one step needs two frames a transition, never more"


def test_observations_for_the_bonus_are_those_stored() -> None:
    replay = SegmentReplay(SHAPE.size, 1, 0, num_envs=2, capacity=40, frames=SHAPE)
    story = Story(replay)
    for _ in range(90):
        story.step()
    known = {tuple(after[env]) for time, (_, after) in story.seen.items() if time > 60 for env in range(2)}
    drawn = {tuple(row) for row in replay.observations(500).tolist()}
    assert drawn <= known
    assert len(drawn) == len(replay)


def test_frames_are_stored_once() -> None:
    replay = SegmentReplay(SHAPE.size, 1, 0, num_envs=2, capacity=1000, frames=SHAPE)
    story = Story(replay, (5, 5))
    for _ in range(100):
        story.step()
    frames = replay.state_dict()["frames"]
    assert frames["frames"].dtype == torch.uint8
    assert len(frames["frames"]) == 2 * 100 + 2 * 20  # transitions, and the starts of episodes


def test_saving_and_loading_in_mid_episode_after_a_full_turn() -> None:
    replays = [SegmentReplay(SHAPE.size, 1, 0, num_envs=2, capacity=40, frames=SHAPE) for _ in range(2)]
    story = Story(replays[0], (5, 7))
    for _ in range(63):
        story.step()
    replays[1].load_state_dict(replays[0].state_dict())
    assert len(replays[1]) == len(replays[0])
    story.replay = replays[1]
    check(replays[1], story)
    for _ in range(63):
        story.step()
        check(replays[1], story, samples=40)


def test_frames_that_do_not_fit() -> None:
    replay = SegmentReplay(SHAPE.size, 1, 0, num_envs=2, capacity=40, frames=SHAPE)
    floats = np.zeros((2, SHAPE.size), np.float32)
    with pytest.raises(
        RPGError, match=r"observations are torch.float32 of shape \(2, 8\), expected uint8 of \(2, 8\)"
    ):
        replay.add(floats, np.zeros((2, 1)), np.zeros(2), floats, np.zeros(2), np.zeros(2), torch.zeros(2, 0))
    with pytest.raises(RPGError, match="replay capacity=8 frames: must be at least 12"):
        SegmentReplay(SHAPE.size, 1, 0, num_envs=2, capacity=8, frames=SHAPE)
    with pytest.raises(RPGError, match="frames of 30 x 64 pixels: the encoder needs at least 39 x 39"):
        PixelTrunk(FrameShape(1, 30, 64, 3), 8)


def test_the_encoder_sees_frames_in_order_and_colours_as_channels() -> None:
    shape = FrameShape(2, 40, 44, 3)
    encoder = pixel_encoder(shape, 8, 16, 5, "silu")
    pixels = torch.randint(0, 256, (3, 4, shape.size), dtype=torch.uint8)
    out = encoder(pixels)
    assert out.shape == (3, 4, 5)
    images = pixels.view(12, 2, 40, 44, 3).permute(0, 1, 4, 2, 3).reshape(12, 6, 40, 44) / 255
    trunk = encoder[0]
    features = trunk.convolutions(images).flatten(1)
    torch.testing.assert_close(encoder[1](features).view(3, 4, 5), out)


class Dot(gym.Env[np.ndarray, np.ndarray]):
    """A bright dot on a black picture that the action moves."""

    def __init__(self, side: int = 40) -> None:
        self.observation_space = Box(0, 255, (side, side, 3), np.uint8)
        self.action_space = Box(-1, 1, (2,), np.float32)
        self.side = side

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.at = self.np_random.uniform(0, self.side, 2)
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.at = (self.at + 4 * action).clip(0, self.side - 1)
        return self.observe(), float(self.at[0] > 30), False, False, {}

    def observe(self) -> np.ndarray:
        picture = np.zeros((self.side, self.side, 3), np.uint8)
        x, y = self.at.astype(int)
        picture[x : x + 3, y : y + 3] = (255, 128, 0)
        return picture


@pytest.mark.parametrize("mode", ["fixed", "policy_gradient"])
def test_a_run_on_pictures_trains_saves_and_goes_on(composed: Any, tmp_path: Path, mode: str) -> None:
    from rpg.train import train

    gym.register("Dot-v0", entry_point=Dot, max_episode_steps=20)
    overrides = [
        "experiment=debug", "env=gymnasium", "env.id=Dot-v0", "env.frame_stack=2", "env.num_envs=2",
        "size.channels=8", "trainer.decisions_per_update=4", "trainer.replay_capacity=300", "trainer.eval_every=0",
        f"agent.prior.mode={mode}", f"run_dir={tmp_path}", "logger=files",
    ]  # fmt: skip
    try:
        train(composed(*overrides, "trainer.steps=300"))
        train(composed(*overrides, "trainer.steps=500"))
    finally:
        del gym.registry["Dot-v0"]
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert state["updates"] > 90
    assert len(state["replay"]["frames"]["frames"]) == 300
    assert state["agent"]["model"]["encoder.0.convolutions.0.weight"].shape == (8, 6, 7, 7)
