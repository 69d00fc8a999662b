"""Half-cheetah, paid only for having run backward far enough (Sec. 3.4.3, Fig. 3.10)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rpg.envs.mujoco.scene import gymnasium_asset
from rpg.envs.mujoco.simulation import Array, MujocoTask
from rpg.errors import RPGError
from rpg.exploration.objects import ObjectsOfInterest

_FRAME_SKIP = 5
_NOISE = 0.1


class CheetahBackEnv(MujocoTask):
    """The robot, start and simulation of gymnasium's HalfCheetah-v5, with another reward.

    Observation, (18,) float32: positions ``qpos[0:9]``, x of the root included, and velocities ``qvel[0:9]``.
    Action: (6,) in [-1, 1]; one step is 0.05 s. The reward is 1 for every step that ends with the root more than
    ``distance`` behind where the episode began, else 0; ``info["success"]`` says the same and
    ``info["x_position"]`` where the root is. Nothing terminates.

    Start: positions are off by up to 0.1 (uniform), velocities are normal with deviation 0.1.

    Args:
        distance: metres, against the direction in which the robot looks.
        render_mode: "rgb_array" or None.
        camera: "track", beside the robot.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an argument outside its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        distance: float = 20.0,
        render_mode: str | None = None,
        camera: str = "track",
        render_size: int = 256,
    ) -> None:
        if not distance > 0:
            raise RPGError(f"cheetah_back: distance {distance} must be positive")
        xml = gymnasium_asset("half_cheetah.xml")
        super().__init__("cheetah_back", xml, _FRAME_SKIP, 18, render_mode, camera, render_size)
        self.distance = distance
        self._start = 0.0
        self.objects_of_interest = ObjectsOfInterest.of((0, 1, 2), (1 / distance, 1.0, 1 / math.pi))

    def _place(self, options: dict[str, Any]) -> None:
        self._qpos += self.np_random.uniform(-_NOISE, _NOISE, self.model.nq)
        self._qvel += _NOISE * self.np_random.standard_normal(self.model.nv)
        self._start = float(self._qpos[0])

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Drive the motors for 0.05 s; ``action`` (6,).

        Raises:
            RPGError: an action of another shape.
            NonFiniteError: an action that is not finite, or a simulation that diverged.
        """
        self._simulate(action)
        observation = self._observe()
        x = float(self._qpos[0])
        success = self._start - x > self.distance
        return observation, float(success), False, False, {"success": success, "x_position": x}

    def _observe(self) -> Array:
        np.concatenate((self._qpos, self._qvel), out=self._buffer)
        return self._finished_observation()
