"""What batched environments with goals share: layout, reward, success, horizon, seeds, state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rpg.envs.checks import checked_actions, checked_choices, checked_render_mode, checked_reset_mask
from rpg.envs.maze_picture import Disc, Frame, MazeCanvas
from rpg.envs.single import SingleEnv
from rpg.envs.streams import Floats, Integers, Streams
from rpg.errors import RPGError
from rpg.exploration.objects import ObjectsOfInterest
from rpg.goals import GoalSpec

Array = NDArray[Any]

RANDOM = "random"
"""Instead of a place: another one in each episode."""

REWARDS = ("sparse", "dense")


def checked_reward(name: str, reward: str) -> str:
    """``reward`` as it was given: "sparse" or "dense".

    Raises:
        RPGError: anything else.
    """
    if reward not in REWARDS:
        raise RPGError(f"{name}: reward '{reward}' is unknown; use {' or '.join(map(repr, REWARDS))}")
    return reward


def checked_horizon(name: str, episode_steps: int) -> int:
    """``episode_steps`` as it was given.

    Raises:
        RPGError: it is below 1.
    """
    if episode_steps < 1:
        raise RPGError(f"{name}: episode_steps {episode_steps} must be at least 1")
    return episode_steps


def goal_reward(spec: GoalSpec, reward: str, observations: Array) -> tuple[Floats, Floats]:
    """Reward and distance, each (...), of observations (..., S + G) that steps have ended in.

    "sparse" is -1, or 0 within ``spec.relabel_radius`` of the goal; "dense" is minus the L2 distance.
    """
    state, goal = spec.split(observations)
    achieved = spec.achieved_goal(state)
    distance = np.linalg.norm(achieved - goal, axis=-1).astype(np.float64)
    if reward == "dense":
        return -distance, distance
    return np.asarray(spec.arrived(achieved, goal), dtype=np.float64) - 1.0, distance


class GoalVectorEnv(VectorEnv[Array, Array, Array], ABC):
    """Many copies of one task with goals, all of them moved by a handful of numpy calls.

    Observation, float32: the state, then the desired goal, as ``goal_spec`` says. Episodes never terminate, on
    arrival neither; they are truncated after ``episode_steps``. ``info["success"]`` (num_envs,) bool says which
    are within ``goal_spec.success_radius`` of their goals at the end of the step, ``info["distance"]`` how far
    from them all are.

    ``reset`` takes ``options={"start": ..., "goal": ...}``, (num_envs, d) each, instead of what the constructor
    was told. What an episode draws depends on its seed alone.

    Args:
        num_envs: number of copies.
        spec: how the observation is laid out.
        state_low: (S,) bounds of the state.
        state_high: (S,).
        action_space: of one copy, a ``Discrete`` or ``Box(-1, 1)``.
        episode_steps: steps to an episode.
        reward: "sparse", -1 or 0 on arrival, or "dense", minus the distance.
        render_mode: "rgb_array" or None.
        internal_dim: numbers that the simulator keeps for each copy; None: as many as the state has.

    Raises:
        RPGError: an argument outside its range.
    """

    name: ClassVar[str]
    option_dims: ClassVar[dict[str, int]] = {"start": 2, "goal": 2}
    metadata: dict[str, Any] = {  # noqa: RUF012 (as gymnasium declares it)
        "render_modes": ["rgb_array"],
        "render_fps": 15,
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(
        self,
        num_envs: int,
        spec: GoalSpec,
        state_low: Floats,
        state_high: Floats,
        action_space: Box | Discrete,
        episode_steps: int,
        reward: str,
        render_mode: str | None,
        internal_dim: int | None = None,
    ) -> None:
        if num_envs < 1:
            raise RPGError(f"{self.name}: num_envs {num_envs} must be at least 1")
        self.num_envs, self.goal_spec = num_envs, spec
        self.episode_steps = checked_horizon(self.name, episode_steps)
        self.reward = checked_reward(self.name, reward)
        self.render_mode = checked_render_mode(self.name, render_mode)
        low, high = state_low.astype(np.float32), state_high.astype(np.float32)
        bounds = [spec.join(bound, spec.achieved_goal(bound)) for bound in (low, high)]
        self.single_observation_space = Box(bounds[0], bounds[1], dtype=np.float32)
        self.single_action_space = action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        middle, half = (spec.achieved_goal(v) for v in ((low + high) / 2, (high - low) / 2))
        self.objects_of_interest = ObjectsOfInterest.of(spec.achieved, (1 / half).tolist(), middle.tolist())

        self._streams = Streams(num_envs)
        self._state: Floats = np.zeros((num_envs, internal_dim or spec.state_dim))
        self._goal: Floats = np.zeros((num_envs, spec.goal_dim))
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._canvas: MazeCanvas | None = None

    @abstractmethod
    def _begin(self, rows: Integers, start: Floats | None, goal: Floats | None) -> None:
        """Put the environments ``rows`` at a start and give them goals: (len(rows), d), or None to draw them."""

    @abstractmethod
    def _advance(self, actions: Array) -> None:
        """One step of all; ``actions`` are (num_envs, action_dim) in [-1, 1], or (num_envs,) numbers."""

    def _seen(self) -> Array:
        """The state as it is observed, (num_envs, S)."""
        return self._state

    @abstractmethod
    def _make_canvas(self) -> MazeCanvas:
        """What pictures are drawn on."""

    @abstractmethod
    def _drawn(self, env: int) -> tuple[Floats, list[Disc]]:
        """Where the point is in a picture, and what lies under it."""

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start new episodes, everywhere or where ``options["reset_mask"]`` (num_envs,) bool is True.

        Raises:
            RPGError: options that the task cannot follow.
        """
        mask = checked_reset_mask(self.name, self.num_envs, seed, options)
        options = options or {}
        if unknown := sorted(options.keys() - {"reset_mask", *self.option_dims}):
            raise RPGError(f"{self.name} reset: unknown option '{unknown[0]}'; use start, goal, reset_mask")
        rows = np.flatnonzero(mask)
        given = {key: self._given(key, options[key])[rows] for key in self.option_dims if key in options}
        self._streams.seed(mask, seed)
        self._begin(rows, given.get("start"), given.get("goal"))
        self._elapsed[mask] = 0
        return self._observations(), {}

    def step(self, actions: Array) -> tuple[Array, Floats, Array, Array, dict[str, Any]]:
        """Move every copy; ``actions`` (num_envs, action_dim), clipped to [-1, 1], or (num_envs,) whole numbers.

        Raises:
            NonFiniteError: an action is NaN or infinite.
            RPGError: ``actions`` of another shape or type.
        """
        space = self.single_action_space
        if isinstance(space, Discrete):
            self._advance(checked_choices(self.name, actions, self.num_envs, int(space.n)))
        else:
            shape = (self.num_envs, *(space.shape or ()))
            self._advance(checked_actions(self.name, actions, shape, self._elapsed).clip(-1.0, 1.0))
        self._elapsed += 1
        observations = self._observations()
        reward, distance = goal_reward(self.goal_spec, self.reward, observations)
        info = {"success": distance <= self.goal_spec.success_radius, "distance": distance}
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        return observations, reward, terminated, self._elapsed >= self.episode_steps, info

    def get_state(self) -> dict[str, Any]:
        """Simulator states, goals, steps since the last reset, random streams, copied."""
        return {
            "state": self._state.copy(),
            "goal": self._goal.copy(),
            "elapsed": self._elapsed.copy(),
            "streams": self._streams.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue, bit-equal, from what :meth:`get_state` returned.

        Raises:
            RPGError: the state is of another number of environments.
        """
        kept = np.array(state["state"], dtype=np.float64)
        if kept.shape != self._state.shape:
            raise RPGError(
                f"{self.name}: the state holds {len(kept)} environments, this one {self.num_envs}; set num_envs "
                "as in the run that saved it"
            )
        self._state, self._goal = kept, np.array(state["goal"], dtype=np.float64)
        self._elapsed = np.array(state["elapsed"], dtype=np.int64)
        self._streams.set_state(state["streams"])

    def render(self) -> tuple[Frame, ...] | None:
        """One uint8 (256, 256, 3) RGB frame for each environment, or None without a render mode."""
        if self.render_mode is None:
            return None
        if self._canvas is None:
            self._canvas = self._make_canvas()
        return tuple(self._canvas.frame(*self._drawn(env)) for env in range(self.num_envs))

    def _observations(self) -> Array:
        observations = np.empty((self.num_envs, self.goal_spec.obs_dim), dtype=np.float32)
        state, goal = self.goal_spec.split(observations)
        state[:], goal[:] = self._seen(), self._goal
        return observations

    def _given(self, key: str, value: Any) -> Floats:
        try:
            places = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            places = np.empty(0)
        shape = (self.num_envs, self.option_dims[key])
        if places.shape != shape or not np.isfinite(places).all():
            raise RPGError(f"{self.name} reset: {key} must be finite numbers of shape {shape}, not {value!r}")
        return places


class SingleGoalEnv(SingleEnv):
    """One copy out of :class:`GoalVectorEnv`, for gymnasium's single-env tools.

    Args:
        kwargs: those of the batch, without ``num_envs``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012
    batch: ClassVar[type[Any]]

    def __init__(self, **kwargs: Any) -> None:
        made: GoalVectorEnv = self.batch(1, **kwargs)
        super().__init__(made, made.render_mode)
        self.goal_spec = made.goal_spec
        self.objects_of_interest = made.objects_of_interest

    def render(self) -> Frame | None:
        """A uint8 (256, 256, 3) RGB frame, or None without a render mode."""
        frames = self._batch.render()
        return None if frames is None else frames[0]
