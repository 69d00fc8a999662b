"""Films of whole episodes, drawn without a screen."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray

from rpg.agents.agent import Agent
from rpg.errors import RPGError
from rpg.training.runner import Runner
from rpg.videos import video_writer

_HOLD = 0.5  # seconds that the last picture of an episode stays


def film(
    agent: Agent,
    envs: VectorEnv[Any, Any, Any],
    path: Path,
    episodes: int,
    seed: int,
    deterministic: bool = True,
    name: str = "env",
) -> None:
    """Write whole episodes as a video, without touching random state of training.

    Args:
        agent: acts.
        envs: a single one, made with ``render_mode="rgb_array"``; reset here.
        path: ``.mp4``, or ``.gif`` for a picture that moves.
        episodes: how many, one after the other.
        seed: equal seeds give equal episodes.
        deterministic: as in :func:`rpg.training.runner.evaluate`.
        name: of the environment, for messages.

    Raises:
        RPGError: the environment draws nothing, or the file cannot be written.
    """
    fps = float(envs.metadata.get("render_fps") or 30)
    devices = [agent.device] if agent.device.type == "cuda" else []
    with agent.evaluating(), torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with video_writer(path, fps) as writer:
                camera = _Camera(envs, writer, episodes, max(1, round(_HOLD * fps)), name)
                runner = Runner(agent, camera, seed, name)
                runner.reset()
                while camera.episodes:
                    runner.step(deterministic)
        except OSError as error:
            raise RPGError(f"video {path}: {error.strerror or error}; choose another place") from error


def check_pictures(make: Callable[[], VectorEnv[Any, Any, Any]], seed: int, name: str) -> None:
    """Draw one picture of the environment that ``make`` makes, so that what is missing shows before a long run.

    Raises:
        RPGError: there is none, or drawing needs a package that is missing.
    """
    with closing(make()) as envs:
        envs.reset(seed=seed)
        _picture(envs, name)


def _picture(envs: VectorEnv[Any, Any, Any], name: str) -> NDArray[np.uint8]:
    """Of the first environment, (height, width, 3)."""
    try:
        frames = envs.render()
    except gym.error.DependencyNotInstalled as error:
        raise RPGError(f"{name}: no video, {' '.join(str(error).split())}") from error
    if not frames or frames[0] is None:
        raise RPGError(
            f"{name}: the environment draws no pictures (render_mode 'rgb_array'), so there is no video"
        )
    return np.asarray(frames[0], dtype=np.uint8)


class _Camera(VectorWrapper):
    """Passes everything through, and takes a picture of what it leads to until enough episodes are over."""

    def __init__(
        self, envs: VectorEnv[Any, Any, Any], writer: Any, episodes: int, hold: int, name: str
    ) -> None:
        super().__init__(envs)
        self._writer, self.episodes, self._hold, self._name = writer, episodes, hold, name

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        out = super().reset(**kwargs)
        self._take(1)
        return out

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        out = super().step(actions)
        over = bool(out[2][0] or out[3][0])
        self._take(self._hold if over else 1)
        self.episodes -= over
        return out

    def _take(self, times: int) -> None:
        if not self.episodes:
            return
        frame = _picture(self.env, self._name)
        height, width = frame.shape[:2]
        even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)))  # as the codec wants it
        for _ in range(times):
            self._writer.append_data(even)
