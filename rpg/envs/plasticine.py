"""Plasticine tasks, batched: one call of the simulator moves every scene of a batch (thesis 2.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rpg.envs.checks import checked_action, checked_render_mode, checked_reset_mask
from rpg.envs.single import SingleEnv
from rpg.errors import RPGError
from rpg.exploration.objects import ObjectsOfInterest
from rpg.plasticine.backend import Particles
from rpg.plasticine.picture import Frame, Painter
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.score import normalised_increment
from rpg.plasticine.state import State

Array = NDArray[Any]
Floats = NDArray[np.float64]

LANDMARKS = 200
"""Particles in an observation, as nearly as a whole stride gives them."""
_LANDMARKS_OF_INTEREST = 8


class PlasticineVectorEnv(VectorEnv[Array, Array, Array]):
    """Scenes of plasticine side by side, all simulated together.

    Observation: x, y, z, vx, vy, vz of every (N // 200)-th particle, then the pose of every tool, fixed ones too:
    position, quaternion w x y z, and the gap of chopsticks. Action: (action_dim,) in [-1, 1], clipped; what an entry
    moves is in ``scene.rig.names``. The reward of a step is the loss at the start less that after the step
    (thesis 2.3.1). Episodes never terminate and are truncated after ``episode_steps``. Nothing is random: every episode
    begins at the scene's start. ``info``: ``loss`` and its terms ``density``, ``sdf``, ``contact``; ``iou`` with the
    target and ``score``, the normalised increment of it (`rpg.plasticine.score`); (num_envs,) each.

    Args:
        num_envs: number of scenes.
        task: one of `rpg.plasticine.scenes.scene_names`, or a scene file of your own.
        variant: of the task.
        scene: more arguments of `rpg.plasticine.scene.load_scene`, such as ``{"particles": 2000, "preset": "fast"}``.
        softness: of contact; 0 is hard, as in the published evaluation.
        episode_steps: steps to an episode; None takes the scene's horizon.
        render_mode: "rgb_array" or None.
        picture_size: side of rendered frames, pixels.

    Raises:
        RPGError: an unknown task or setting, or an argument outside its range.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as gymnasium declares it)
        "render_modes": ["rgb_array"],
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "move",
        variant: int = 1,
        scene: Mapping[str, Any] | None = None,
        softness: float = 0.0,
        episode_steps: int | None = None,
        render_mode: str | None = None,
        picture_size: int = 256,
    ) -> None:
        self.scene: Scene = load_scene(task, variant, **(scene or {}))
        self.name = self.scene.name
        self.num_envs = num_envs
        self.episode_steps = self.scene.horizon if episode_steps is None else episode_steps
        if num_envs < 1 or self.episode_steps < 1 or softness < 0:
            raise RPGError(
                f"{self.name}: num_envs={num_envs} and episode_steps={self.episode_steps} must be at least 1, "
                f"softness={softness} not negative"
            )
        self.softness = softness
        self.render_mode = checked_render_mode(self.name, render_mode)
        self.picture_size = picture_size
        self._painter: Painter | None = None

        self._start = self.scene.initial_state(num_envs)
        with torch.no_grad():
            self._first_loss = float(self.scene.loss(self.scene.initial_state()).total)
        self._state = self._start
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        stride = max(1, self.scene.n_particles // LANDMARKS)
        self._landmarks = slice(None, None, stride)
        grips = [tool.shape == "chopsticks" for tool in self.scene.tools]
        kept = np.array([[True] * 7 + [grip] for grip in grips], dtype=np.bool_).reshape(-1)
        self._pose_numbers = torch.from_numpy(np.flatnonzero(kept)).to(self.scene.device)

        marks = -(-self.scene.n_particles // stride)
        dim = 6 * marks + int(kept.sum())
        self.single_observation_space = Box(-np.inf, np.inf, (dim,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (self.scene.action_dim,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.objects_of_interest = _objects(marks, grips, self.scene.rig.movable)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start new episodes, everywhere or where ``options["reset_mask"]`` (num_envs,) bool is True.

        Seeds are accepted as in ``SyncVectorEnv`` and change nothing.
        """
        mask = checked_reset_mask(self.name, self.num_envs, seed, options)
        self._elapsed[mask] = 0
        self._state = self._start if mask.all() else _replaced(self._state, self._start, mask)
        return self._observe(), {}

    def step(self, actions: Array) -> tuple[Array, Floats, Array, Array, dict[str, Any]]:
        """One environment step of every scene; ``actions`` (num_envs, action_dim).

        Raises:
            NonFiniteError: an action is NaN or infinite, or the simulation blew up; all scenes stay as they were.
            RPGError: ``actions`` has another shape.
        """
        dim = self.scene.action_dim
        rows = np.asarray(actions, dtype=np.float64)
        if rows.ndim != 2 or len(rows) != self.num_envs:
            raise RPGError(
                f"{self.name}: actions have shape {rows.shape}, expected {(self.num_envs, dim)}, one row for each "
                "environment"
            )
        checked = np.stack([checked_action(self.name, row, dim) for row in rows])
        with torch.no_grad():
            before = self._state._replace(time=int(self._elapsed.max()))
            after = self.scene.step(before, torch.from_numpy(checked).to(self.scene.device), self.softness)
            loss = self.scene.loss(after)
            iou = self.scene.iou(after)
            score = normalised_increment(iou, *self.scene.iou_bounds)
        terms = {
            "loss": loss.total, "density": loss.density, "sdf": loss.sdf, "contact": loss.contact,
            "iou": iou, "score": score,
        }  # fmt: skip
        info: dict[str, Any] = {name: value.double().cpu().numpy() for name, value in terms.items()}
        self._state = after
        self._elapsed += 1
        reward = self._first_loss - info["loss"]
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        return self._observe(), reward, terminated, self._elapsed >= self.episode_steps, info

    def get_state(self) -> dict[str, Any]:
        """Particles, tools and steps since the last reset, copied: all that a step depends on."""
        parts = {**self._state.particles._asdict(), "poses": self._state.poses}
        arrays = {name: tensor.cpu().numpy().copy() for name, tensor in parts.items()}
        return {**arrays, "elapsed": self._elapsed.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue, bit-equal, from what :meth:`get_state` returned.

        Raises:
            RPGError: the state is of other scenes.
        """
        parts: dict[str, torch.Tensor] = {**self._start.particles._asdict(), "poses": self._start.poses}
        given = {}
        for name, own in parts.items():
            array = np.array(state[name])
            if array.shape != own.shape:
                raise RPGError(
                    f"{self.name}: the state's {name} have shape {array.shape}, here {tuple(own.shape)}; "
                    "set num_envs and scene as in the run that saved it"
                )
            given[name] = torch.from_numpy(array).to(own)
        poses = given.pop("poses")
        self._state = State(Particles(**given), poses, self._start.material)
        self._elapsed = np.array(state["elapsed"], dtype=np.int64)

    def render(self) -> tuple[Frame, ...] | None:
        """One uint8 (picture_size, picture_size, 3) RGB frame for each scene, or None without a render mode."""
        if self.render_mode is None:
            return None
        if self._painter is None:
            self._painter = Painter(self.scene, self.picture_size)
        return tuple(self._painter.frame(self._state, index) for index in range(self.num_envs))

    def _observe(self) -> Array:
        x, v = (t[:, self._landmarks] for t in self._state.particles[:2])
        body = torch.cat([x, v], -1).flatten(1)
        tools = self._state.poses.flatten(1).index_select(1, self._pose_numbers)
        observation: Array = torch.cat([body.double(), tools], 1).float().cpu().numpy()
        return observation


def _replaced(state: State, start: State, mask: NDArray[np.bool_]) -> State:
    """``start`` where ``mask``, else ``state``; as ever, tensors that were handed out are left alone."""
    chosen = torch.from_numpy(mask).to(state.poses.device)

    def pick(new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
        return torch.where(chosen.view(-1, *[1] * (old.dim() - 1)), new, old)

    particles = Particles(*(pick(a, b) for a, b in zip(start.particles, state.particles, strict=True)))
    return state._replace(particles=particles, poses=pick(start.poses, state.poses))


def _objects(marks: int, grips: list[bool], movable: tuple[int, ...]) -> ObjectsOfInterest:
    """Positions of a few landmarks and of the tools that move, from the unit cube to [-1, 1]."""
    shown = np.unique(np.linspace(0, marks - 1, _LANDMARKS_OF_INTEREST).round().astype(int))
    index = [6 * int(mark) + axis for mark in shown for axis in range(3)]
    begin = 6 * marks + np.cumsum([0] + [7 + grip for grip in grips])
    index += [int(begin[tool]) + axis for tool in movable for axis in range(3)]
    return ObjectsOfInterest.of(index, scale=2.0, offset=0.5)


class PlasticineEnv(SingleEnv):
    """One scene: `PlasticineVectorEnv` with a batch of one, for gymnasium's single-environment tools.

    Args:
        task: as there, and so all others.
        variant: of the task.
        scene: more arguments of `rpg.plasticine.scene.load_scene`.
        softness: of contact.
        episode_steps: steps to an episode.
        render_mode: "rgb_array" or None.
        picture_size: side of rendered frames, pixels.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        task: str = "move",
        variant: int = 1,
        scene: Mapping[str, Any] | None = None,
        softness: float = 0.0,
        episode_steps: int | None = None,
        render_mode: str | None = None,
        picture_size: int = 256,
    ) -> None:
        batch = PlasticineVectorEnv(
            1, task, variant, scene, softness, episode_steps, render_mode, picture_size
        )
        super().__init__(batch, render_mode)
        self.scene = batch.scene
        self.objects_of_interest = batch.objects_of_interest

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """The batch's step, for one action (action_dim,).

        Raises:
            RPGError: the action has another shape.
            NonFiniteError: as in the batch.
        """
        return super().step(checked_action(self._batch.name, action, self.scene.action_dim))

    def render(self) -> Frame | None:
        """A uint8 (picture_size, picture_size, 3) RGB frame, or None without a render mode."""
        frames = self._batch.render()
        return None if frames is None else frames[0]
