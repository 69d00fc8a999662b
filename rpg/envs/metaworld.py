"""Meta-World: a Sawyer arm with a gripper, 50 tasks, with sparse or dense rewards.

Basketball and stick-pull are tasks of the thesis (Sec. 3.4.2). Scenes, starts, success and dense rewards are those of
the installed ``metaworld`` package; goals are observable, and object and goal are placed at random at every reset.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from numpy.typing import NDArray

from rpg.envs.checks import checked_action
from rpg.envs.mujoco_picture import PicturedSimulation, View
from rpg.errors import NonFiniteError, RPGError, nearest
from rpg.exploration.objects import ObjectsOfInterest

Array = NDArray[Any]
Floats = NDArray[np.float64]

OBS_SCALE = 0.05
"""What every entry of an observation is multiplied by."""
STATE_DIM = 39
"""Entries of Meta-World's own observation: 18 now, the same 18 one control step ago, 3 of the goal."""

_NOW = 18
_OBJECT = 7  # position and quaternion
_LENGTH = 0.4  # metres that count as 1 in an object scalar
_SETTLE_ANEW = (
    *("box-close", "disassemble", "door-lock", "door-unlock", "handle-press", "handle-press-side"),
    *("handle-pull", "handle-pull-side", "lever-pull", "peg-unplug-side"),
)
"""Where the scene's random place decides what happens while the hand moves to its start."""
_HOOP_HEIGHT, _HOOP_RADIUS, _FLASK_RADIUS = 0.3, 0.08, 0.12  # metres; the suite's conditions of success
_VIEW = View((0.0, 0.65, 0.12), 1.5, 165.0, -28.0)


def symlog(x: Floats) -> Floats:
    """``sign(x) ln(1 + |x|)``, elementwise."""
    compressed: Floats = np.copysign(np.log1p(np.abs(x)), x)
    return compressed


class MetaWorldEnv(PicturedSimulation):
    """One task of Meta-World (``rpg/MetaWorld-v0``).

    Observation (39 + k,) float32, everything times 0.05: Meta-World's own 39 numbers with the goal visible, then
    the object scalars, which are the objects of interest. These are, with symlog(x) = sign(x) ln(1 + |x|) and
    lengths in units of 0.4 m:

    * stick-pull: symlog(stick - handle), symlog(stick - tcp), opening of the gripper (k = 7);
    * any other task: symlog(tcp - object), symlog(object) for each of its one or two objects, opening of the
      gripper (k = 7 or 13). For basketball this is what was published.

    tcp is the point between the fingertips. Action (4,) in [-1, 1]: motion of the hand by up to 1 cm a control
    step along x, y, z, and effort of the gripper, positive to close. Reward: the success flag after the last
    repeat, or, with ``reward="dense"``, the sum of Meta-World's own rewards over the repeats. Nothing terminates.

    Start: object and goal from the task's own ranges, then one control step without motion.

    Args:
        task: a name of the suite, such as "basketball-v3".
        reward: "sparse" or "dense".
        action_repeat: control steps of 0.0125 s to one decision.
        render_mode: "rgb_array" or None.
        camera: a camera of the model, such as "topview" or "behindGripper", or None for a view of our own.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an unknown task, or an argument outside its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 40}  # noqa: RUF012 (as gymnasium declares it)

    def __init__(
        self,
        task: str = "basketball-v3",
        reward: str = "sparse",
        action_repeat: int = 2,
        render_mode: str | None = None,
        camera: str | None = None,
        render_size: int = 256,
    ) -> None:
        if task not in ALL_V3_ENVIRONMENTS:
            raise RPGError(f"metaworld: unknown task '{task}': {nearest(task, ALL_V3_ENVIRONMENTS)}")
        if reward not in ("sparse", "dense"):
            raise RPGError(f"metaworld {task}: reward '{reward}' is unknown; use 'sparse' or 'dense'")
        if action_repeat < 1:
            raise RPGError(f"metaworld {task}: action_repeat {action_repeat} must be at least 1")
        self.simulation = _simulation(task)
        super().__init__(
            f"metaworld {task}",
            self.simulation.model,
            self.simulation.data,
            render_mode,
            camera,
            render_size,
            _VIEW,
        )
        self._settles_anew = task.removesuffix("-v3") in _SETTLE_ANEW
        self._dense = reward == "dense"
        self.action_repeat = action_repeat
        self.metadata = self.metadata | {"render_fps": round(1 / (self.simulation.dt * action_repeat))}
        self._decisions = 0
        self._keep_views()

        # What the two published tasks need is read straight from the simulator; the suite takes longer for it than
        # for the physics.
        self._stick_pull = task == "stick-pull-v3"
        own: dict[str, Callable[[], bool]] = {
            "basketball-v3": self._ball_at_hoop,
            "stick-pull-v3": self._flask_at_goal,
        }
        self._succeeded = own.get(task)
        if self._stick_pull:
            stick = self.model.body("stick").id
            self._stick, self._stick_rotation = self.data.xpos[stick], self.data.xquat[stick]
            sites = (self.model.site(name).id for name in ("insertion", "stick_end"))
            self._handle, self._stick_end = (self.data.site_xpos[site] for site in sites)
        objects = 1 if self._stick_pull else len(self.simulation._get_pos_objects()) // 3
        self._scalars = np.zeros(6 * objects + 1)
        obs_dim = STATE_DIM + len(self._scalars)
        self.objects_of_interest = ObjectsOfInterest.of(range(STATE_DIM, obs_dim), scale=1 / OBS_SCALE)
        self.observation_space = Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = Box(-1.0, 1.0, (4,), np.float32)

    def _keep_views(self) -> None:
        """Views of the simulator's own arrays; they stay valid as long as the data does."""
        simulation, data = self.simulation, self.data
        bodies = (self.model.body(name).id for name in ("hand", "rightclaw", "leftclaw"))
        self._hand, self._right, self._left = (data.xpos[body] for body in bodies)
        sites = (self.model.site(name).id for name in ("rightEndEffector", "leftEndEffector"))
        self._right_tip, self._left_tip = (data.site_xpos[site] for site in sites)
        self._qpos, self._ctrl = data.qpos, data.ctrl
        self._mocap, self._mocap_quat = data.mocap_pos[0], data.mocap_quat
        self._low, self._high = simulation.mocap_low, simulation.mocap_high
        bounds = simulation.sawyer_observation_space
        self._state_low, self._state_high = bounds.low, bounds.high
        self._state = np.zeros(STATE_DIM)

    @property
    def state(self) -> Floats:
        """Meta-World's own observation (39,), unscaled, in metres: what its scripted policies take."""
        return self._state.copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start the next episode with object and goal at random places."""
        super().reset(seed=seed)
        simulation = self.simulation
        simulation.np_random = self.np_random
        # The suite draws a start in each of the two passes of its reset, and some tasks mix the two; here the
        # second pass repeats the first one's.
        simulation.remember = True
        simulation._freeze_rand_vec = False
        simulation.reset_model()
        simulation.remember = not self._settles_anew
        simulation._freeze_rand_vec = True
        start, _ = MujocoEnv.reset(simulation)
        simulation._prev_obs = start[:_NOW].copy()
        self._state[:] = simulation.step(np.zeros(4))[0]
        self._decisions = 0
        return self._observe(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Move for ``action_repeat`` control steps.

        Raises:
            RPGError: an action of another shape.
            NonFiniteError: an action that is not finite, or a simulation that diverged.
        """
        action = checked_action(self._name, action, 4)
        simulation = self.simulation
        motion = action[:3] * simulation.action_scale
        self._ctrl[:] = action[3], -action[3]
        self._mocap_quat[:] = 1.0, 0.0, 1.0, 0.0  # pointing down
        self._decisions += 1
        total, success = 0.0, False
        for remaining in range(self.action_repeat - 1, -1, -1):
            self._mocap += motion
            np.clip(self._mocap, self._low, self._high, out=self._mocap)
            mujoco.mj_step(self.model, self.data, simulation.frame_skip)
            if self._dense or (self._succeeded is None and not remaining):
                mujoco.mj_forward(self.model, self.data)
                self._read()
                reward, info = simulation.evaluate_state(self._state, action)
                total += float(reward)
                success = bool(info["success"])
            else:
                mujoco.mj_kinematics(self.model, self.data)  # positions are all that is read
                self._read()
        if not self._dense:
            if self._succeeded is not None:
                success = self._succeeded()
            total = float(success)
        return self._observe(), total, False, False, {"success": success}

    def close(self) -> None:
        """Free simulation and renderer."""
        super().close()
        self.simulation.close()

    def _read(self) -> None:
        """Take the present state in, as Meta-World's own observation.

        Raises:
            NonFiniteError: the simulation has diverged.
        """
        if not np.isfinite(self._qpos).all():
            raise NonFiniteError(
                f"{self._name}: the simulation diverged at decision {self._decisions} of the episode; "
                "reset it to go on"
            )
        state, simulation = self._state, self.simulation
        state[_NOW : 2 * _NOW] = state[:_NOW]
        state[:3] = self._hand
        state[3] = min(math.dist(self._right, self._left) / 0.1, 1.0)
        if self._stick_pull:
            state[4:7] = self._stick
            state[7:11] = _scalar_last(self._stick_rotation)
            state[11:14] = self._handle
        else:
            positions, rotations = simulation._get_pos_objects(), simulation._get_quat_objects()
            for i in range(len(positions) // 3):
                first = 4 + _OBJECT * i
                state[first : first + 3] = positions[3 * i : 3 * i + 3]
                state[first + 3 : first + _OBJECT] = rotations[4 * i : 4 * i + 4]
        np.clip(state, self._state_low, self._state_high, out=state)

    def _ball_at_hoop(self) -> bool:
        """Whether the ball is near the point above the hoop; its height counts twice."""
        x, y, z = self._state[4:7].tolist()
        goal_x, goal_y, _ = self._state[36:].tolist()
        return math.hypot(x - goal_x, y - goal_y, 2 * (z - _HOOP_HEIGHT)) <= _HOOP_RADIUS

    def _flask_at_goal(self) -> bool:
        """Whether the handle of the flask is near the goal and the stick through it."""
        handle, end = self._handle.tolist(), self._stick_end.tolist()
        through = end[0] >= handle[0] and abs(end[1] - handle[1]) <= 0.04 and abs(end[2] - handle[2]) <= 0.06
        return through and math.dist(handle, self._state[36:].tolist()) <= _FLASK_RADIUS

    def _observe(self) -> Array:
        state, scalars = self._state, self._scalars
        tcp = (self._right_tip + self._left_tip) / 2
        if self._stick_pull:
            stick = state[4:7]
            np.subtract(stick, state[11:14], out=scalars[:3])
            np.subtract(stick, tcp, out=scalars[3:6])
        else:
            for i in range(len(scalars) // 6):
                place = state[4 + _OBJECT * i : 7 + _OBJECT * i]
                np.subtract(tcp, place, out=scalars[6 * i : 6 * i + 3])
                scalars[6 * i + 3 : 6 * i + 6] = place
        scalars[:-1] = symlog(scalars[:-1] / _LENGTH)
        scalars[-1] = state[3]
        return (np.concatenate((state, scalars)) * OBS_SCALE).astype(np.float32)


def _scalar_last(quaternion: Floats) -> Floats:
    """MuJoCo's (w, x, y, z) as (x, y, z, w), of the two signs the one that makes the largest entry positive."""
    turned = np.roll(quaternion, -1)
    if turned[np.abs(turned).argmax()] < 0:
        np.negative(turned, out=turned)
    return turned


def _simulation(task: str) -> Any:
    """The suite's environment of a task: goal visible, starts from its own generator, no end to its episodes."""
    simulation = _settling_once(ALL_V3_ENVIRONMENTS[task])()
    simulation._set_task_called = True
    simulation._partially_observable = False
    del simulation.sawyer_observation_space  # cached for a hidden goal
    simulation.seeded_rand_vec = True  # or it would draw from numpy's global generator
    simulation.max_path_length = sys.maxsize
    mujoco.mj_resetData(simulation.model, simulation.data)
    simulation._reset_hand()
    return simulation


def _settling_once(task: Any) -> Any:
    """A task class that simulates most of the hand's way to its start once and remembers where it got to.

    It is the same motion from the same state, 50 control steps, and the suite makes it twice at every reset. The
    last of them is made every time: tasks read from it where the object that they have just moved is.
    """

    class SettlingOnce(task):
        remember = True
        _settled: Any = None

        def _reset_hand(self, steps: int = 50) -> None:
            if not self.remember:
                super()._reset_hand(steps)
                return
            if self._settled is None:
                super()._reset_hand(steps - 1)
                self._settled = mujoco.MjData(self.model)
                mujoco.mj_copyData(self._settled, self.model, self.data)
            mujoco.mj_copyData(self.data, self.model, self._settled)
            super()._reset_hand(1)

    return SettlingOnce
