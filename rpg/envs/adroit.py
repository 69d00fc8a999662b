"""Adroit: a hand of 24 joints on an arm opens a door or drives a nail, with sparse rewards.

The tasks are those of DAPG (Rajeswaran et al. 2018) as in Sec. 3.4.2 of the thesis; scene, actuators and start come
from gymnasium-robotics' ``AdroitHandDoorEnv`` and ``AdroitHandHammerEnv``. They are stepped without their time limit.
"""

from __future__ import annotations

import contextlib
import io
import math
from abc import ABC, abstractmethod
from typing import Any

import mujoco
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rpg.envs.checks import checked_action
from rpg.envs.mujoco_picture import PicturedSimulation, View
from rpg.errors import NonFiniteError, RPGError
from rpg.exploration.objects import ObjectsOfInterest

with contextlib.redirect_stderr(io.StringIO()):  # a notice about dense rewards, which are not used here
    from gymnasium_robotics.envs.adroit_hand.adroit_door import AdroitHandDoorEnv
    from gymnasium_robotics.envs.adroit_hand.adroit_hammer import AdroitHandHammerEnv

Array = NDArray[Any]

OBS_SCALE = 0.05
"""What every entry of an observation is multiplied by."""

_MAX_SPEED = 1.0  # of the hammer in the observation, m/s and rad/s
_GIMBAL = 4 * np.finfo(np.float64).eps


class AdroitTask(PicturedSimulation, ABC):
    """What both tasks share: actions, repeats, rewards, the start and pictures.

    Args:
        name: of the task, for messages.
        simulation: the environment of gymnasium-robotics; only its model, data, start and action scale are used.
        obs_dim: entries of the observation.
        objects: which of them are objects of interest.
        action_repeat: control steps of 0.01 s to one decision.
        render_mode: "rgb_array" or None.
        camera: a camera of the model, "fixed" or "vil_camera", or None for a view from the side.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an argument outside its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 (as gymnasium declares it)
    view: View
    """Where pictures are drawn from without a camera."""

    def __init__(
        self,
        name: str,
        simulation: Any,
        obs_dim: int,
        objects: tuple[int, ...],
        action_repeat: int,
        render_mode: str | None,
        camera: str | None,
        render_size: int,
    ) -> None:
        if action_repeat < 1:
            raise RPGError(f"{name}: action_repeat {action_repeat} must be at least 1")
        super().__init__(name, simulation.model, simulation.data, render_mode, camera, render_size, self.view)
        self.simulation = simulation
        self.action_repeat = action_repeat
        self.metadata = self.metadata | {"render_fps": round(1 / (simulation.dt * action_repeat))}
        self.objects_of_interest = ObjectsOfInterest.of(objects, scale=1 / OBS_SCALE)
        self.action_space = Box(-1.0, 1.0, (int(self.model.nu),), np.float32)
        self.observation_space = Box(-np.inf, np.inf, (obs_dim,), np.float32)

        self._action_dim = int(self.model.nu)
        self._substeps = int(simulation.frame_skip)
        self._middle, self._half_range = simulation.act_mean, simulation.act_rng
        # Views of the simulator's own arrays: they stay valid as long as the data does.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._palm = self._site("S_grasp")
        self._buffer = np.zeros(obs_dim)
        self._decisions = 0

    @abstractmethod
    def _achieved(self) -> bool:
        """Whether the goal is reached in the present state."""

    @abstractmethod
    def _read(self) -> None:
        """Fill the buffer with the observation, not yet scaled."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start the next episode: the hand at rest, the door or board at a random place."""
        super().reset(seed=seed)
        self.simulation.np_random = self.np_random
        self.simulation.reset()
        self._decisions = 0
        return self._observe(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the joint targets ``action`` for ``action_repeat`` control steps.

        The reward is the share of these after which the goal was reached, success whether it was after the last.

        Raises:
            RPGError: an action of another shape.
            NonFiniteError: an action that is not finite, or a simulation that diverged.
        """
        targets = checked_action(self._name, action, self._action_dim)
        np.multiply(targets, self._half_range, out=self._ctrl)
        self._ctrl += self._middle
        reached, achieved = 0, False
        for _ in range(self.action_repeat):
            mujoco.mj_step(self.model, self.data, self._substeps)
            achieved = self._achieved()
            reached += achieved
        self._decisions += 1
        reward = reached / self.action_repeat
        return self._observe(), reward, False, False, {"success": achieved}

    def close(self) -> None:
        """Free simulation and renderer."""
        super().close()
        self.simulation.close()

    def _observe(self) -> Array:
        self._read()
        if not np.isfinite(self._buffer).all():
            raise NonFiniteError(
                f"{self._name}: the simulation diverged at decision {self._decisions} of the episode; "
                "reset it to go on"
            )
        return (self._buffer * OBS_SCALE).astype(np.float32)

    def _site(self, name: str) -> Array:
        """The position of a site, (3,), a view that follows the simulation."""
        position: Array = self.data.site_xpos[self.model.site(name).id]
        return position


class AdroitDoorEnv(AdroitTask):
    """Turn the latch and open the door (``rpg/AdroitDoor-v0``).

    Observation (37,) float32, everything times 0.05: 27 joint angles of arm and hand, palm x y z, hinge angle of
    the door, handle x y z, palm minus handle x y z; rad and m. The last seven are the objects of interest. The
    latch is not observed. Action (28,) in [-1, 1]: joint targets over their ranges. Reward: the share of the
    repeats after which the hinge is open by ``hinge_angle``; nothing terminates.

    Start: the door frame at x in U(-0.3, -0.2), y in U(0.25, 0.35), z in U(0.252, 0.35); all else at rest.

    Args:
        hinge_angle: from which on the door is open, rad.
        action_repeat: control steps of 0.01 s to one decision.
        render_mode: "rgb_array" or None.
        camera: "fixed", "vil_camera" or None for a view of our own.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an argument outside its range.
    """

    view = View((-0.05, 0.0, 0.2), 1.6, 60.0, -25.0)

    def __init__(
        self,
        hinge_angle: float = 1.0,
        action_repeat: int = 2,
        render_mode: str | None = None,
        camera: str | None = None,
        render_size: int = 256,
    ) -> None:
        name = "adroit_door"
        if not 0 < hinge_angle <= math.pi / 2:
            raise RPGError(f"{name}: hinge_angle {hinge_angle} must lie in (0, pi/2]; the hinge ends at 1.57")
        super().__init__(
            name,
            AdroitHandDoorEnv(reward_type="sparse"),
            obs_dim=37,
            objects=tuple(range(30, 37)),
            action_repeat=action_repeat,
            render_mode=render_mode,
            camera=camera,
            render_size=render_size,
        )
        self._hinge_angle = hinge_angle
        self._hinge = int(self.model.joint("door_hinge").qposadr[0])
        self._handle = self._site("S_handle")

    def _achieved(self) -> bool:
        return bool(self._qpos[self._hinge] >= self._hinge_angle)

    def _read(self) -> None:
        buffer = self._buffer
        buffer[:27] = self._qpos[1:28]  # without the slide of the arm, as in DAPG
        buffer[27:30] = self._palm
        buffer[30] = self._qpos[self._hinge]
        buffer[31:34] = self._handle
        np.subtract(self._palm, self._handle, out=buffer[34:37])


class AdroitHammerEnv(AdroitTask):
    """Pick up the hammer and drive the nail in (``rpg/AdroitHammer-v0``).

    Observation (49,) float32, everything times 0.05: the 46 numbers of DAPG, which are 26 joint angles of arm and
    hand, travel of the nail, velocity of the hammer (6, clipped to +-1), palm x y z, hammer x y z, Euler angles of
    the hammer, nail x y z, force on the nail (clipped to +-1), and then the hammer's head x y z; rad, m, s, N.
    Palm, head and nail are the objects of interest. Action (26,) in [-1, 1]: joint targets over their ranges.
    Reward: the share of the repeats after which the nail is within ``nail_tolerance`` of its goal; nothing
    terminates.

    Start: the board at height U(0.1, 0.25), the hammer on the table, all else at rest.

    Args:
        nail_tolerance: distance at which the nail counts as driven in, m; 0.020 as published, DAPG takes 0.010.
        action_repeat: control steps of 0.01 s to one decision.
        render_mode: "rgb_array" or None.
        camera: "fixed", "vil_camera" or None for a view of our own.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an argument outside its range.
    """

    view = View((0.0, -0.15, 0.1), 1.4, 60.0, -25.0)

    def __init__(
        self,
        nail_tolerance: float = 0.020,
        action_repeat: int = 2,
        render_mode: str | None = None,
        camera: str | None = None,
        render_size: int = 256,
    ) -> None:
        name = "adroit_hammer"
        if not 0 < nail_tolerance < 0.09:
            raise RPGError(
                f"{name}: nail_tolerance {nail_tolerance} must lie in (0, 0.09), the nail's length"
            )
        super().__init__(
            name,
            AdroitHandHammerEnv(reward_type="sparse"),
            obs_dim=49,
            objects=(33, 34, 35, 46, 47, 48, 42, 43, 44),
            action_repeat=action_repeat,
            render_mode=render_mode,
            camera=camera,
            render_size=render_size,
        )
        self._tolerance = nail_tolerance
        self._nail, self._goal, self._head = (self._site(s) for s in ("S_target", "nail_goal", "tool"))
        hammer = self.model.body("Object").id
        self._hammer, self._rotation = self.data.xpos[hammer], self.data.xmat[hammer]
        touch = int(self.model.sensor("S_nail").adr[0])
        self._force = self.data.sensordata[touch : touch + 1]

    def _achieved(self) -> bool:
        return math.dist(self._nail, self._goal) <= self._tolerance

    def _read(self) -> None:
        buffer = self._buffer
        buffer[:27] = self._qpos[:27]
        np.clip(self._qvel[27:], -_MAX_SPEED, _MAX_SPEED, out=buffer[27:33])
        buffer[33:36] = self._palm
        buffer[36:39] = self._hammer
        buffer[39:42] = euler_angles(self._rotation.tolist())
        buffer[42:45] = self._nail
        np.clip(self._force, -1.0, 1.0, out=buffer[45:46])
        buffer[46:49] = self._head


def euler_angles(rotation: list[float]) -> tuple[float, float, float]:
    """Angles about x, y, z, rad, of a rotation matrix given row by row (9,), in the convention of DAPG.

    The matrix is that of turns about z, then y, then x, with all angles negated; where y is at +-pi/2 and only a
    sum of the others is known, x is 0.
    """
    xx, xy, xz, yx, yy, yz, _, _, zz = rotation
    cosine = math.hypot(zz, yz)
    y = math.atan2(xz, cosine)
    if cosine > _GIMBAL:
        return -math.atan2(yz, zz), y, -math.atan2(xy, xx)
    return 0.0, y, math.atan2(yx, yy)
