"""Films of episodes: every step is in them, the last picture is that of the end, training does not notice."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from omegaconf import DictConfig
from PIL import Image, ImageSequence
from torch import Tensor

from rpg.agents import Agent
from rpg.errors import RPGError
from rpg.evaluate import main as evaluate_main
from rpg.train import train
from rpg.training.build import build_trainer, parse_config
from rpg.training.video import film


class Dial(gym.Env[np.ndarray, np.ndarray]):
    """Shows the number of the step as brightness; three steps an episode; odd sides."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, draws: bool = True) -> None:
        self.observation_space = Box(0, 9, (1,), np.float32)
        self.action_space = Box(-1, 1, (1,), np.float32)
        self.render_mode, self.t = ("rgb_array" if draws else None), 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.t += 1
        return np.full(1, self.t, np.float32), 0.0, False, self.t == 3, {}

    def render(self) -> Any:
        return np.full((31, 33, 3), 60 * self.t, np.uint8) if self.render_mode else None


class Still(Agent):
    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        return torch.zeros(len(obs), 1)


def dial(draws: bool = True) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Dial(draws)], autoreset_mode=AutoresetMode.DISABLED)


def shoot(path: Path, episodes: int, draws: bool = True) -> None:
    envs = dial(draws)
    film(
        Still(envs.single_observation_space, envs.single_action_space),
        envs,
        path,
        episodes,
        seed=0,
        name="dial",
    )


def test_every_step_is_filmed_and_the_end_is_held(tmp_path: Path) -> None:
    shoot(tmp_path / "a.gif", episodes=2)
    with Image.open(tmp_path / "a.gif") as gif:
        shown = [
            (int(np.asarray(f.convert("RGB")).mean() / 60 + 0.5), f.info["duration"])
            for f in ImageSequence.Iterator(gif)
        ]
    # Equal pictures in a row may be stored as one that lasts longer.
    times = [value for value, lasts in shown for _ in range(round(lasts / 250))]
    assert times == [0, 1, 2, 3, 3] * 2


def test_mp4_has_the_same_pictures(tmp_path: Path) -> None:
    shoot(tmp_path / "deep" / "a.mp4", episodes=1)
    with imageio.get_reader(tmp_path / "deep" / "a.mp4") as reader:
        frames = [frame[10, 10].mean() for frame in reader]
        assert reader.get_meta_data()["fps"] == 4
    assert np.allclose(frames, [0, 60, 120, 180, 180], atol=6)


class Undrawable(Dial):
    """Needs a package to draw that is not there."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(draws=render_mode is not None)

    def render(self) -> Any:
        raise gym.error.DependencyNotInstalled("easel is not installed,\nrun `pip install easel`")


def test_a_missing_package_shows_before_training(composed: Callable[..., DictConfig]) -> None:
    gym.register("Undrawable-v0", Undrawable)
    try:
        run = composed("env=gymnasium", "id=Undrawable-v0", "trainer.video_every=1000")
        with pytest.raises(RPGError, match="^Undrawable-v0: no video, easel is not installed, run `pip"):
            build_trainer(parse_config(run))
    finally:
        gym.registry.pop("Undrawable-v0")


def test_what_cannot_be_filmed(tmp_path: Path) -> None:
    with pytest.raises(RPGError, match="dial: the environment draws no pictures"):
        shoot(tmp_path / "a.gif", 1, draws=False)
    with pytest.raises(RPGError, match=r"a\.avi: choose a name that ends with .mp4 or .gif"):
        shoot(tmp_path / "a.avi", 1)
    (tmp_path / "file").write_text("")
    with pytest.raises(RPGError, match="choose another place"):
        shoot(tmp_path / "file" / "a.mp4", 1)


def test_a_run_with_videos_is_the_same_run(
    composed: Callable[..., DictConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = ("experiment=debug", "trainer.steps=200", "trainer.eval_every=0", "trainer.picture_every=0")
    plain, filmed = (
        train(composed(*tiny, f"run_dir={tmp_path / str(every)}", f"trainer.video_every={every}"))
        for every in (0, 100)
    )
    same = [key for key in plain if not key.startswith(("time/", "wall_s"))]
    assert {key: plain[key] for key in same} == {key: filmed[key] for key in same}
    assert sorted(p.name for p in (tmp_path / "100" / "videos").iterdir()) == [
        "000000100.mp4",
        "000000200.mp4",
    ]
    video = tmp_path / "again.gif"
    assert evaluate_main([str(tmp_path / "0"), "--episodes=1", f"--video={video}", "--video-episodes=1"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["video"] == str(video)
    with Image.open(video) as gif:
        assert sum(f.info["duration"] for f in ImageSequence.Iterator(gif)) >= 51 * 1000 / 15 * 0.9
