"""Any ManiSkill task as a batch that the trainer can use: numpy arrays, resets by mask, no questions asked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import mani_skill.envs  # noqa: F401 (registers ManiSkill's own tasks)
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from mani_skill.agents import REGISTERED_AGENTS
from mani_skill.utils import assets, download_asset
from mani_skill.utils.registration import REGISTERED_ENVS
from numpy.typing import NDArray

import rpg.envs.sapien.cabinet_maniskill  # noqa: F401 (registers the cabinet tasks)
from rpg.envs.checks import checked_render_mode
from rpg.envs.sapien.physics import VULKAN_REMEDY
from rpg.errors import NonFiniteError, RPGError, nearest

Array = NDArray[Any]

STATE, RGB = "state", "rgb"


class ManiSkillBatch(VectorEnv[Array, Array, Array]):
    """``num_envs`` copies of a ManiSkill task in ``AutoresetMode.DISABLED``.

    On a GPU they are one batched simulation; on a CPU, where ManiSkill simulates one scene at a time, they
    are stepped one after the other in this process.

    Observation: (num_envs, d) float32 for ``obs_mode="state"``; (num_envs, height, width, 3 c) uint8 for
    "rgb", the task's c cameras one after the other. Action: (num_envs, a), bounded. A time limit truncates;
    ``info["success"]`` (num_envs,) bool where the task has such a thing.

    Args:
        num_envs: how many.
        task: ManiSkill's id, such as "PickCube-v1".
        obs_mode: "state" or "rgb"; only pictures need a graphics driver.
        reward_mode: ManiSkill's; None takes the task's first.
        control_mode: ManiSkill's; None takes the robot's first.
        sim_backend: "physx_cpu", "physx_cuda", or "auto": the GPU if there is one and more than one environment.
        render_backend: ManiSkill's; None opens a renderer only for pictures.
        max_episode_steps: decisions until truncation; None takes the task's.
        terminate: end episodes at success or failure, as ManiSkill does, instead of only at the time limit.
        render_mode: None or "rgb_array".
        task_kwargs: arguments of the task itself, such as ``robot_uids``.

    Raises:
        RPGError: an unknown task, files that must be downloaded first, no device, or arguments that do not fit.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as gymnasium declares it)
        "render_modes": ["rgb_array"],
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "PickCube-v1",
        obs_mode: str = STATE,
        reward_mode: str | None = None,
        control_mode: str | None = None,
        sim_backend: str = "auto",
        render_backend: str | None = None,
        max_episode_steps: int | None = None,
        terminate: bool = False,
        render_mode: str | None = None,
        **task_kwargs: Any,
    ) -> None:
        self._check(num_envs, task, obs_mode, render_mode, max_episode_steps)
        self._task, self._obs_mode, self._terminate = task, obs_mode, terminate
        self.num_envs, self.render_mode = num_envs, render_mode
        spec = REGISTERED_ENVS[task]
        self._limit = max_episode_steps or spec.max_episode_steps
        on_gpu = self._on_gpu(sim_backend)
        pictures = obs_mode == RGB or render_mode is not None
        arguments: dict[str, Any] = {
            **spec.default_kwargs,
            "obs_mode": obs_mode,
            "sim_backend": "physx_cuda" if on_gpu else "physx_cpu",
            "render_backend": render_backend or (_renderer() if pictures else "none"),
            "render_mode": render_mode,
            **task_kwargs,
        }
        arguments |= {} if reward_mode is None else {"reward_mode": reward_mode}
        arguments |= {} if control_mode is None else {"control_mode": control_mode}
        part_size = num_envs if on_gpu else 1
        with _plain_errors(task):
            self._parts = [spec.cls(num_envs=part_size, **arguments) for _ in range(num_envs // part_size)]
        self._rows = [slice(i, i + part_size) for i in range(0, num_envs, part_size)]
        first = self._parts[0]
        self.single_action_space = self._checked_actions(first.single_action_space)
        sample = self._numpy(first.reset(seed=[0] * part_size)[0])
        self._obs: Array = np.zeros((num_envs, *sample.shape[1:]), dtype=sample.dtype)
        self.single_observation_space = (
            Box(0, 255, sample.shape[1:], np.uint8)
            if obs_mode == RGB
            else Box(-np.inf, np.inf, sample.shape[1:], np.float32)
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        objects = getattr(first, "objects_of_interest", None)
        if objects is not None:
            self.objects_of_interest = objects

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start new episodes, everywhere or where ``options["reset_mask"]`` (num_envs,) bool is True.

        Args:
            seed: one for each environment, or one from which they count up, or None.
            options: ``reset_mask`` is read, nothing else.

        A GPU batch draws all its random numbers from one stream, which ManiSkill seeds with the first entry.
        So there an episode depends on the seeds of all environments that start with it.
        """
        mask = (options or {}).get("reset_mask")
        mask = np.ones(self.num_envs, dtype=np.bool_) if mask is None else np.asarray(mask)
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise RPGError(
                f"{self._task} reset: reset_mask {mask!r} must be a bool array of shape ({self.num_envs},), "
                "True at least once"
            )
        seeds = self._seeds(seed)
        for part, rows in zip(self._parts, self._rows, strict=True):
            chosen = np.flatnonzero(mask[rows])
            if not chosen.size:
                continue
            part_seeds = None if seeds is None else seeds[rows]
            part_options: dict[str, Any] = {}
            if chosen.size < part.num_envs:
                part_options["env_idx"] = torch.as_tensor(chosen, device=part.device)
                if part_seeds is not None and chosen[0] != 0:
                    part_seeds[0] = _mixed([part_seeds[i] for i in chosen])
            with _plain_errors(self._task):  # a reset may build the scene anew
                obs, _ = part.reset(seed=part_seeds, options=part_options)
            self._obs[rows][chosen] = self._numpy(obs)[chosen]
        self._elapsed[mask] = 0
        return self._obs.copy(), {}

    def step(self, actions: Array) -> tuple[Array, NDArray[np.float64], Array, Array, dict[str, Any]]:
        """One decision everywhere; ``actions`` (num_envs, a).

        Raises:
            NonFiniteError: an action is NaN or infinite.
            RPGError: ``actions`` has another shape.
        """
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise RPGError(
                f"{self._task} step: actions have shape {actions.shape}, expected {self.action_space.shape}"
            )
        if not np.isfinite(actions).all():
            env = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
            raise NonFiniteError(
                f"{self._task}: action {actions[env].tolist()} of environment {env} is not finite; "
                "look at the policy that produced it"
            )
        reward = np.zeros(self.num_envs)
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        info: dict[str, Any] = {}
        for part, rows in zip(self._parts, self._rows, strict=True):
            obs, part_reward, ended, _, part_info = part.step(torch.as_tensor(actions[rows]))
            self._obs[rows] = self._numpy(obs)
            reward[rows] = torch.as_tensor(part_reward).cpu().numpy()
            if self._terminate:
                terminated[rows] = ended.cpu().numpy()
            for key in ("success", "fail"):
                if key in part_info:
                    values = info.setdefault(key, np.zeros(self.num_envs, dtype=np.bool_))
                    values[rows] = torch.as_tensor(part_info[key]).cpu().numpy()
        self._elapsed += 1
        truncated = np.zeros_like(terminated) if self._limit is None else self._elapsed >= self._limit
        return self._obs.copy(), reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One uint8 (H, W, 3) frame for each environment, or None without a render mode."""
        if self.render_mode is None:
            return None
        frames = [frame for part in self._parts for frame in part.render().cpu().numpy()]
        return tuple(frame.astype(np.uint8) for frame in frames)

    def close_extras(self, **kwargs: Any) -> None:
        """Free every scene."""
        for part in self._parts:
            part.close()

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int] | None:
        if seed is None:
            return None
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else list(seed)
        if len(seeds) != self.num_envs or any(s is None for s in seeds):
            raise RPGError(
                f"{self._task} reset: seeds {seeds} for {self.num_envs} environments; give one for each"
            )
        return [int(s) % 2**31 for s in seeds if s is not None]

    def _numpy(self, obs: Any) -> Array:
        """ManiSkill's observation of one part as (k, d) float32 or (k, H, W, 3 c) uint8."""
        if self._obs_mode == STATE:
            return np.asarray(obs.cpu().numpy(), dtype=np.float32)
        cameras = [camera["rgb"] for camera in obs["sensor_data"].values()]
        return torch.cat(cameras, dim=-1).cpu().numpy()

    def _checked_actions(self, space: Any) -> Box:
        if not isinstance(space, Box) or len(space.shape) != 1 or not np.isfinite(space.high).all():
            raise RPGError(
                f"{self._task}: the action space {space} is not a bounded vector; choose another control_mode"
            )
        return Box(space.low, space.high, space.shape, np.float32)

    @staticmethod
    def _check(
        num_envs: int, task: str, obs_mode: str, render_mode: str | None, max_episode_steps: int | None
    ) -> None:
        if task not in REGISTERED_ENVS:
            raise RPGError(f"ManiSkill: task '{task}' is unknown; {nearest(task, REGISTERED_ENVS)}")
        if obs_mode not in (STATE, RGB):
            raise RPGError(f"{task}: obs_mode '{obs_mode}' is not supported; use '{STATE}' or '{RGB}'")
        checked_render_mode(task, render_mode)
        if num_envs < 1 or (max_episode_steps is not None and max_episode_steps < 1):
            raise RPGError(
                f"{task}: num_envs={num_envs} and max_episode_steps={max_episode_steps} must be at least 1"
            )
        missing = _missing_assets(REGISTERED_ENVS[task].asset_download_ids or [])
        if missing:
            raise RPGError(_download_hint(task, missing))

    def _on_gpu(self, sim_backend: str) -> bool:
        if sim_backend not in ("auto", "physx_cpu", "physx_cuda"):
            raise RPGError(
                f"{self._task}: sim_backend '{sim_backend}' is unknown; use auto, physx_cpu or physx_cuda"
            )
        available = torch.cuda.is_available()
        if sim_backend == "physx_cuda" and not available:
            raise RPGError(f"{self._task}: sim_backend 'physx_cuda' needs a CUDA device; use 'physx_cpu'")
        return sim_backend == "physx_cuda" or (sim_backend == "auto" and available and self.num_envs > 1)


def _renderer() -> str:
    return "gpu" if torch.cuda.is_available() else "cpu"


def _mixed(seeds: list[int]) -> int:
    return int(np.random.SeedSequence(seeds).generate_state(1)[0]) % 2**31


def _missing_assets(names: Sequence[str]) -> list[str]:
    """Which of a task's declared downloads are not on disk; a group counts as one."""
    missing = []
    for name in names:
        parts = (
            assets.expand_data_group_into_individual_data_source_ids(name)
            if name in assets.DATA_GROUPS
            else [name]
        )
        if not all(assets.is_data_source_downloaded(part) for part in parts):
            missing.append(name)
    return missing


def _download_hint(task: str, names: Sequence[str]) -> str:
    commands = "; ".join(f"python -m mani_skill.utils.download_asset {name}" for name in names)
    return f"{task}: files that ManiSkill does not ship are missing; download them with: {commands}"


def _robot_assets(question: str) -> list[str]:
    """What to download for the robot in ManiSkill's ``question``, which begins with 'Robot <uid> has assets'."""
    uid = next((uid for uid in REGISTERED_AGENTS if question.startswith(f"Robot {uid} ")), None)
    return [] if uid is None else list(REGISTERED_AGENTS[uid].asset_download_ids)


class _DownloadWanted(Exception):
    """ManiSkill was about to ask on the terminal, or to download."""


def _refuse(*args: Any, **kwargs: Any) -> Any:
    raise _DownloadWanted(str(args[0]) if args else "")


@contextmanager
def _plain_errors(task: str) -> Iterator[None]:
    """Turn what goes wrong inside ManiSkill into one line, and keep it from asking or downloading.

    ManiSkill asks on the terminal whether to download missing files, or, with the environment variable
    ``MS_SKIP_ASSET_DOWNLOAD_PROMPT=1``, downloads them unasked; either would stop a training run.
    """
    ask, download = download_asset.prompt_yes_no, download_asset.download
    download_asset.prompt_yes_no = download_asset.download = _refuse
    try:
        yield
    except _DownloadWanted as error:
        raise RPGError(_download_hint(task, _robot_assets(str(error)) or [task])) from error
    except (FileNotFoundError, SystemExit) as error:
        raise RPGError(f"{task}: ManiSkill misses a file: {_line(error)}") from error
    except ImportError as error:
        raise RPGError(f"{task}: ManiSkill misses a package: {_line(error)}") from error
    except RuntimeError as error:
        text = _line(error)
        if "rendering device" in text:
            text += f"; {VULKAN_REMEDY}"
        raise RPGError(f"{task}: ManiSkill cannot build the task: {text}") from error
    except AttributeError as error:
        raise RPGError(
            f"{task}: ManiSkill failed ({_line(error)}); some tasks read what only a renderer has: "
            "set +env.kwargs.render_backend=cpu, or gpu"
        ) from error
    except (TypeError, AssertionError) as error:
        raise RPGError(f"{task}: ManiSkill does not take these arguments: {_line(error)}") from error
    finally:
        download_asset.prompt_yes_no, download_asset.download = ask, download


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
