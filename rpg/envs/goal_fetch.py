"""FetchPush and BlockedFetchReach on gymnasium-robotics (thesis Sec. 4.6.2)."""

from __future__ import annotations

import contextlib
import io
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rpg.envs.checks import checked_action
from rpg.envs.goal_batch import checked_horizon, checked_reward, goal_reward
from rpg.envs.mujoco.ant import numbers
from rpg.envs.mujoco_picture import PicturedSimulation, View
from rpg.errors import NonFiniteError
from rpg.exploration.objects import ObjectsOfInterest
from rpg.goals import GoalSpec

with contextlib.redirect_stderr(io.StringIO()):  # a notice about tasks that are not used here
    from gymnasium_robotics.envs.fetch.push import MujocoFetchPushEnv
    from gymnasium_robotics.envs.fetch.reach import MujocoFetchReachEnv

Array = NDArray[Any]
Vector = tuple[float, float, float]

BLOCKS: tuple[tuple[Vector, Vector], ...] = (
    ((1.34, 0.64, 0.52), (0.18, 0.01, 0.12)),
    ((1.34, 0.86, 0.52), (0.18, 0.01, 0.12)),
)
"""Centre and half size, in metres, of the boxes of BlockedFetchReach: a wall on each side of the gripper's start."""
GOAL_LOW: Vector = (-0.12, 0.19, -0.07)
GOAL_HIGH: Vector = (0.12, 0.26, 0.03)
"""Goals of BlockedFetchReach from the gripper's start; y to either side."""

_ACTIONS = 4
_VIEW = View(lookat=(1.3, 0.75, 0.5), distance=1.6, azimuth=132.0, elevation=-25.0)


class FetchTask(PicturedSimulation):
    """A Fetch robot with a goal in space, to the threshold of Table 4.1.

    Observation, float32: gymnasium-robotics' own, then the goal (x, y, z). Action: (4,) in [-1, 1], a displacement of
    the gripper's target of up to 5 cm along each axis, and the fingers; one step is 0.04 s. Episodes are truncated
    after ``episode_steps``. ``info["success"]`` says whether the goal is within ``radius``,
    ``info["distance"]`` how far it is. ``reset`` takes ``options={"goal": (x, y, z)}`` for one episode.

    Args:
        episode_steps: steps to an episode.
        radius: relabel and success radius of the goal spec, in metres.
        reward: "sparse", -1 or 0 on arrival, or "dense", minus the distance.
        render_mode: "rgb_array" or None.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an argument outside its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    action_repeat = 1
    name: ClassVar[str]
    base: ClassVar[Any]
    achieved: ClassVar[tuple[int, int, int]]

    def __init__(
        self,
        episode_steps: int = 50,
        radius: float = 0.025,
        reward: str = "sparse",
        render_mode: str | None = None,
        render_size: int = 256,
    ) -> None:
        self.simulation = self.base()
        state_dim = int(self.simulation.observation_space["observation"].shape[0])
        super().__init__(
            self.name, self.simulation.model, self.simulation.data, render_mode, None, render_size, _VIEW
        )
        self.goal_spec = GoalSpec.of(state_dim, self.achieved, radius, radius)
        self.episode_steps = checked_horizon(self.name, episode_steps)
        self._reward = checked_reward(self.name, reward)
        home = self.simulation.initial_gripper_xpos
        self.objects_of_interest = ObjectsOfInterest.of(self.achieved, 1 / 0.2, home.tolist())
        self.action_space = Box(-1.0, 1.0, (_ACTIONS,), np.float32)
        self.observation_space = Box(-np.inf, np.inf, (self.goal_spec.obs_dim,), np.float32)
        self._site = self.model.site("target0").id
        self._site_origin = self.model.body("floor0").pos.copy()
        self._elapsed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start the next episode.

        Raises:
            RPGError: a goal that is no point in space.
        """
        super().reset(seed=seed)
        self.simulation.np_random = self.np_random
        observation, _ = self.simulation.reset()
        if options and "goal" in options:
            self.simulation.goal = np.array(numbers(self.name, "goal", options["goal"], (3,)))
        self.model.site_pos[self._site] = self.simulation.goal - self._site_origin
        self._elapsed = 0
        return self._flat(observation["observation"]), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Move the gripper's target; ``action`` (4,).

        Raises:
            RPGError: an action of another shape.
            NonFiniteError: an action that is not finite, or a simulation that diverged.
        """
        seen, *_ = self.simulation.step(checked_action(self.name, action, _ACTIONS))
        self._elapsed += 1
        observation = self._flat(seen["observation"])
        reward, distance = goal_reward(self.goal_spec, self._reward, observation)
        info = {
            "success": bool(distance <= self.goal_spec.success_radius),
            "distance": float(distance),
        }
        return observation, float(reward), False, self._elapsed >= self.episode_steps, info

    def close(self) -> None:
        """Free simulation and renderer."""
        super().close()
        self.simulation.close()

    def _flat(self, state: Array) -> Array:
        observation = self.goal_spec.join(state, self.simulation.goal).astype(np.float32)
        if not np.isfinite(observation).all():
            raise NonFiniteError(
                f"{self.name}: the simulation diverged at step {self._elapsed} of the episode; reset it to go on"
            )
        return observation


class FetchPushEnv(FetchTask):
    """gymnasium-robotics' FetchPush with a threshold of 2.5 cm instead of 5; the goal is for the block."""

    name = "fetch_push"
    base = MujocoFetchPushEnv
    achieved = (3, 4, 5)


class _BlockedReach(MujocoFetchReachEnv):
    """FetchReach among boxes, with goals behind them."""

    initial_qpos: Any  # a dictionary of joints before, positions after the simulation was made

    def _initialize_simulation(self) -> None:
        scene = mujoco.MjSpec.from_file(self.fullpath)
        for number, (centre, half) in enumerate(BLOCKS):
            scene.worldbody.add_geom(
                name=f"block_{number}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=centre,
                size=half,
                rgba=(0.2, 0.3, 0.8, 0.5),
            )
        self.model = scene.compile()
        self.data = mujoco.MjData(self.model)
        self._model_names = self._utils.MujocoModelNames(self.model)
        self._env_setup(initial_qpos=self.initial_qpos)
        self.initial_time = self.data.time
        self.initial_qpos, self.initial_qvel = self.data.qpos.copy(), self.data.qvel.copy()

    def _sample_goal(self) -> Array:
        offset: Array = self.np_random.uniform(GOAL_LOW, GOAL_HIGH)
        offset[1] *= self.np_random.choice((-1.0, 1.0))
        goal: Array = self.initial_gripper_xpos + offset
        return goal


class BlockedFetchReachEnv(FetchTask):
    """The gripper to a goal on the other side of a wall, to its left or right. A reconstruction.

    The thesis says no more than that blocks were added to FetchReach. Here, a wall stands on each side of the gripper,
    24 cm high; goals lie behind one of them and below its top, so the straight way is blocked.
    """

    name = "blocked_fetch_reach"
    base = _BlockedReach
    achieved = (0, 1, 2)
