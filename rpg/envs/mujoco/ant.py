"""The ant on a map: AntPush, AntMaze, AntFall (Nachum et al. 2018), dense and sparse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rpg.envs.mujoco.cell_map import MAPS, WALL, CellMap
from rpg.envs.mujoco.scene import GOAL_SITE, TOP_CAMERA, ant_scene
from rpg.envs.mujoco.simulation import Array, MujocoTask
from rpg.errors import RPGError, nearest
from rpg.exploration.objects import ObjectsOfInterest

ANT_QPOS, ANT_QVEL = 15, 14
CLEARANCE = 1.0
"""Half the side of the square that a standing ant needs, noise of the start included."""

FRAME_SKIP = 5
_REWARD_SCALE = 0.1
TIME_SCALE = 0.001
_NOISE = 0.1
_XY_SCALE, _REST_SCALE = 0.01, 0.1  # of a scaled observation


class AntMapEnv(MujocoTask):
    """An ant that shall come near a goal, among walls and blocks to push.

    Observation, float32: positions ``qpos[0:15]`` and velocities ``qvel[0:14]`` of the ant, decisions since the
    start times 0.001, then x, y, z of each block (33 entries with one block). Action: (8,) in [-1, 1], torques of
    +-30; one step is 0.1 s. Nothing terminates. ``info["success"]`` says whether the torso is nearer to the goal
    than ``success_distance``; ``info["distance"]`` is how far it is.

    Start: the ant's positions are off by up to 0.1 (uniform), its velocities are normal with deviation 0.1.
    ``reset`` takes ``options={"start": (x, y)}`` to put the ant elsewhere and ``options={"goal": ...}`` for a goal
    that holds until the next one is given; either is refused with an RPGError where walls are too near.

    Args:
        cell_map: a key of :data:`rpg.envs.mujoco.cell_map.MAPS`, or a map of your own.
        goal: (x, y), or (x, y, z) to count height, too; None takes the map's.
        reward: "dense", -0.1 times the distance to the goal, or "sparse", 1 for a step that ends in success.
        success_distance: from the goal, in metres.
        scaled: multiply x and y of the torso by 0.01 and all other entries by 0.1, as the published sparse task
            does.
        render_mode: "rgb_array" or None.
        camera: "top", the whole map, or "track", beside the ant.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an argument outside its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        cell_map: str | CellMap = "push",
        goal: Sequence[float] | None = None,
        reward: str = "dense",
        success_distance: float = 5.0,
        scaled: bool = False,
        render_mode: str | None = None,
        camera: str = TOP_CAMERA,
        render_size: int = 256,
    ) -> None:
        if isinstance(cell_map, str):
            if cell_map not in MAPS:
                raise RPGError(f"ant: unknown map '{cell_map}': {nearest(cell_map, MAPS)}")
            name, cell_map = f"ant_{cell_map}", MAPS[cell_map]
        else:
            name = "ant"
        if reward not in ("dense", "sparse"):
            raise RPGError(f"{name}: reward '{reward}' is unknown; use 'dense' or 'sparse'")
        if not success_distance > 0:
            raise RPGError(f"{name}: success_distance {success_distance} must be positive")
        if not cell_map.is_free((0.0, 0.0), CLEARANCE):
            raise RPGError(
                f"{name}: the ant needs {2 * CLEARANCE} x {2 * CLEARANCE} of free floor at its start"
            )
        blocks = len(cell_map.block_cells)
        obs_dim = ANT_QPOS + ANT_QVEL + 1 + 3 * blocks
        super().__init__(name, ant_scene(cell_map), FRAME_SKIP, obs_dim, render_mode, camera, render_size)

        self.cell_map = cell_map
        self.success_distance = success_distance
        self._dense = reward == "dense"
        self._scale = np.ones(obs_dim)
        if scaled:
            self._scale[:] = _REST_SCALE
            self._scale[:2] = _XY_SCALE
        self._goal: tuple[float, ...] = ()
        self._site = self.model.site(GOAL_SITE).id
        self._take_goal(cell_map.goal if goal is None else goal)

        # Slides of all blocks, and which entry of the block part of the observation each of them moves.
        self._home = np.concatenate(
            [self.model.body(f"block_{i}").pos for i in range(blocks)] or [np.zeros(0)]
        )
        moved = [3 * i + "xyz".index(a) for i, (_, _, axes) in enumerate(cell_map.block_cells) for a in axes]
        self._moved = np.array(moved, dtype=np.intp)
        self.objects_of_interest = self._objects(blocks)

    @property
    def goal(self) -> tuple[float, ...]:
        """(x, y) or (x, y, z)."""
        return self._goal

    def _place(self, options: dict[str, Any]) -> None:
        if "goal" in options:
            self._take_goal(options["goal"])
        if "start" in options:
            self._qpos[:2] = checked_start(self._name, self.cell_map, options["start"])
        disturb(self._qpos, self._qvel, self.np_random)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Drive the motors for 0.1 s; ``action`` (8,).

        Raises:
            RPGError: an action of another shape.
            NonFiniteError: an action that is not finite, or a simulation that diverged.
        """
        self._simulate(action)
        observation = self._observe()
        distance = math.dist(self._qpos[: len(self._goal)].tolist(), self._goal)
        success = distance < self.success_distance
        reward = -_REWARD_SCALE * distance if self._dense else float(success)
        return observation, reward, False, False, {"success": success, "distance": distance}

    def _observe(self) -> Array:
        buffer, ant = self._buffer, ANT_QPOS + ANT_QVEL
        buffer[:ANT_QPOS] = self._qpos[:ANT_QPOS]
        buffer[ANT_QPOS:ant] = self._qvel[:ANT_QVEL]
        buffer[ant] = TIME_SCALE * self._elapsed
        if self._moved.size:
            blocks = buffer[ant + 1 :]
            blocks[:] = self._home
            blocks[self._moved] += self._qpos[ANT_QPOS:]
        buffer *= self._scale
        return self._finished_observation()

    def _objects(self, blocks: int) -> ObjectsOfInterest:
        """x and y of the torso and of each block, the map's longer side as [-1, 1]."""
        first = ANT_QPOS + ANT_QVEL + 1
        index = [0, 1] + [first + 3 * i + j for i in range(blocks) for j in range(2)]
        low, high = self.cell_map.bounds
        middle, half = (low + high) / 2, float((high - low).max()) / 2 - self.cell_map.cell  # walls aside
        unit = self._scale[index]
        offset = np.tile(middle, 1 + blocks) * unit
        return ObjectsOfInterest.of(index, (1 / (half * unit)).tolist(), offset.tolist())

    def _take_goal(self, goal: Sequence[float] | None) -> None:
        if goal is None:
            raise RPGError(f"{self._name}: this map has no goal of its own; give goal=(x, y)")
        place = numbers(self._name, "goal", goal, (2, 3))
        if self.cell_map.character_at(place[:2]) == WALL:
            raise RPGError(f"{self._name}: goal {place} lies in a wall or outside the map")
        self._goal = place
        height = place[2] if len(place) == 3 else self.cell_map.floor_height + 0.5
        self.model.site_pos[self._site] = (*place[:2], height)


def disturb(qpos: Array, qvel: Array, rng: np.random.Generator) -> None:
    """Add the published noise to an ant's position (15,) and set its velocity (14,) to some, in place."""
    qpos[:ANT_QPOS] += rng.uniform(-_NOISE, _NOISE, ANT_QPOS)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    qvel[:ANT_QVEL] = _NOISE * rng.standard_normal(ANT_QVEL)


def checked_start(name: str, cell_map: CellMap, value: Any) -> tuple[float, ...]:
    """A place (x, y) where an ant has room.

    Raises:
        RPGError: it has not.
    """
    start = numbers(name, "start", value, (2,))
    if not cell_map.is_free(start, CLEARANCE):
        raise RPGError(f"{name}: start {start} has less than {CLEARANCE} of free floor around it")
    return start


def numbers(name: str, what: str, value: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
    """``value`` as floats.

    Raises:
        RPGError: not as many finite numbers as one of ``counts``.
    """
    try:
        given = tuple(float(v) for v in value)
    except (TypeError, ValueError):
        given = ()
    if len(given) not in counts or not all(map(math.isfinite, given)):
        raise RPGError(f"{name}: {what} {value!r} must be {' or '.join(map(str, counts))} finite numbers")
    return given
