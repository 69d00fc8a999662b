"""What the tasks share: a model, its state, actions, pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import mujoco
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rpg.envs.checks import checked_action
from rpg.envs.mujoco_picture import PicturedSimulation
from rpg.errors import NonFiniteError

Array = NDArray[Any]


class MujocoTask(PicturedSimulation, ABC):
    """A MuJoCo model whose motors take actions in [-1, 1]; a task adds its start, observation and ``step``.

    Args:
        name: of the task, for messages.
        xml: MJCF text.
        frame_skip: simulation steps to one ``step``.
        obs_dim: entries of the observation.
        render_mode: "rgb_array" or None.
        camera: name of a camera in the model.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an unknown render mode or camera, or a picture of no size.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (as gymnasium declares it)
    action_repeat = 1

    def __init__(
        self,
        name: str,
        xml: str,
        frame_skip: int,
        obs_dim: int,
        render_mode: str | None,
        camera: str,
        render_size: int,
    ) -> None:
        model: Any = mujoco.MjModel.from_xml_string(xml)
        super().__init__(name, model, mujoco.MjData(model), render_mode, camera, render_size)
        self._frame_skip = frame_skip
        # Views of the simulator's own arrays: they stay valid as long as the data does.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._action_dim = int(self.model.nu)
        self._buffer = np.zeros(obs_dim)
        self._elapsed = 0
        self.observation_space = Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = Box(-1.0, 1.0, (self._action_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start the next episode.

        Raises:
            RPGError: options that the task cannot follow.
        """
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self._elapsed = 0
        self._place(options or {})
        mujoco.mj_forward(self.model, self.data)
        return self._observe(), {}

    @abstractmethod
    def _place(self, options: dict[str, Any]) -> None:
        """Move everything from the model's initial state to a start of the task's."""

    @abstractmethod
    def _observe(self) -> Array:
        """The observation, (obs_dim,) float32."""

    def _simulate(self, action: Array) -> None:
        """One action's time of simulation.

        Raises:
            RPGError: an action of another shape.
            NonFiniteError: an action that is not finite.
        """
        self._ctrl[:] = checked_action(self._name, action, self._action_dim)
        mujoco.mj_step(self.model, self.data, self._frame_skip)
        self._elapsed += 1

    def _finished_observation(self) -> Array:
        """The buffer as a new float32 array.

        Raises:
            NonFiniteError: the simulation has diverged.
        """
        if not np.isfinite(self._buffer).all():
            raise NonFiniteError(
                f"{self._name}: the simulation diverged at step {self._elapsed} of the episode "
                f"(torso or root at {self._qpos[:3].tolist()}); reset it to go on"
            )
        return self._buffer.astype(np.float32)
