"""Push blocks onto their goals in a walled square (BlockPush, thesis Sec. 3.5.2)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import gymnasium
import numpy as np
import sapien
from gymnasium.spaces import Box
from numpy.typing import NDArray
from sapien import physx

from rpg.envs.checks import checked_action, checked_render_mode
from rpg.envs.sapien.block_picture import BlockPainter, Frame
from rpg.envs.sapien.physics import physics_scene, physx_settings
from rpg.errors import RPGError
from rpg.exploration.objects import ObjectsOfInterest

Floats = NDArray[np.float32]

HALF_SIZE = 0.2  # of a block and of the agent, m
ARENA = 1.8  # centres stay within +-ARENA; the inner faces of the walls stand at ARENA + HALF_SIZE
WALL = 0.1  # half thickness of a wall, m
SPEED = 4.0  # of the agent at an action of 1, m/s
SUBSTEPS, TIMESTEP = 8, 0.01
BLOCK_DAMPING = 5000.0  # of a block's sliders, N s/m: a block of 64 kg that is let go stops within 3 cm
TOLERANCE = 0.2  # a block is in place when closer than this to its goal, m
AGENT_START = (0.0, -1.4)
MAX_BLOCKS = 6


def layout(blocks: int) -> tuple[Floats, Floats]:
    """Starts and goals of ``blocks`` blocks, each (blocks, 2) float32, in m.

    Up to three blocks stand as published (thesis task: 2). More than three share one row, evenly.
    """
    if blocks <= 3:
        start_x, goal_x = 1.2 * np.arange(-1, blocks - 1), 1.4 * np.arange(-1, blocks - 1)
    else:
        start_x = goal_x = np.linspace(-1.4, 1.4, blocks)
    starts = np.stack([start_x, np.zeros(blocks)], axis=1).astype(np.float32)
    goals = np.stack([goal_x, np.full(blocks, 1.4)], axis=1).astype(np.float32)
    return starts, goals


class BlockPhysics:
    """Boxes on two slider joints each, between four walls; gravity plays no part.

    Args:
        blocks: how many, besides the agent.
    """

    def __init__(self, blocks: int) -> None:
        self.starts, self.goals = layout(blocks)
        with physx_settings(
            gravity=(0.0, 0.0, 0.0),
            contact_offset=0.02,
            position_iterations=25,
            velocity_iterations=0,
            persistent_contacts=False,
            friction=0.0,
        ):
            self._scene = physics_scene(TIMESTEP)
            self._add_walls()
            self._blocks = [self._slider(f"block{i}", BLOCK_DAMPING) for i in range(blocks)]
            self._agent = self._slider("agent", 0.0)
        self.position: Floats = np.zeros((blocks + 1, 2), dtype=np.float32)
        """Centres of the blocks, then of the agent, m."""
        self.velocity: Floats = np.zeros((blocks + 1, 2), dtype=np.float32)
        """The same order, m/s."""
        self.reset()

    def reset(self) -> None:
        """Everything at its start, at rest."""
        at_rest = np.zeros(2, dtype=np.float32)
        for body, start in zip((*self._blocks, self._agent), (*self.starts, AGENT_START), strict=True):
            body.set_qpos(start)
            body.set_qvel(at_rest)
        self._read()

    def step(self, action: NDArray[Any]) -> None:
        """Move the agent at ``SPEED * action`` (2,), as far as it is free to go, for one control step."""
        velocity = np.asarray(SPEED * action, dtype=np.float32)
        agent, system = self._agent, self._scene.physx_system
        for _ in range(SUBSTEPS):
            agent.set_qvel(velocity)  # an obstacle takes speed away within a sub-step, never for longer
            system.step()
        self._read()

    def close(self) -> None:
        """Free the scene."""
        self._scene.clear()

    def _read(self) -> None:
        for row, body in enumerate((*self._blocks, self._agent)):
            self.position[row] = body.qpos
            self.velocity[row] = body.qvel

    def _add_walls(self) -> None:
        rough = physx.PhysxMaterial(1.0, 1.0, 0.0)
        middle = ARENA + HALF_SIZE + WALL
        for axis in (0, 1):
            for side in (-middle, middle):
                builder = self._scene.create_actor_builder()
                size = np.full(3, 0.5)
                size[axis], size[1 - axis] = WALL, middle + WALL
                place = np.zeros(3)
                place[axis] = side
                builder.add_box_collision(half_size=size, material=rough)
                builder.set_initial_pose(sapien.Pose(place))
                builder.build_static()

    def _slider(self, name: str, damping: float) -> Any:
        """A box of 64 kg that slides along x and y within the arena and cannot turn."""
        builder = self._scene.create_articulation_builder()
        link = builder.create_link_builder()
        along_y = sapien.Pose(q=[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
        for axis, frame in (("x", sapien.Pose()), ("y", along_y)):
            link = builder.create_link_builder(link)
            link.set_joint_name(f"{name}_{axis}")
            link.set_joint_properties("prismatic", [[-ARENA, ARENA]], frame, frame, 0.0, damping)
        link.add_box_collision(half_size=[HALF_SIZE] * 3)
        return builder.build(fix_root_link=True)


class _BlockPush(gymnasium.Env[NDArray[Any], Floats], ABC):
    """What the state and the picture version share; ``_observe`` is theirs."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 12}  # noqa: RUF012
    action_repeat = 1
    name = "BlockPush"

    def __init__(self, blocks: int, render_mode: str | None, picture_size: int) -> None:
        if not 1 <= blocks <= MAX_BLOCKS:
            raise RPGError(f"{self.name}: blocks={blocks} must be between 1 and {MAX_BLOCKS}")
        if picture_size < 16:
            raise RPGError(f"{self.name}: picture_size={picture_size} must be at least 16")
        self.render_mode = checked_render_mode(self.name, render_mode)
        self.picture_size = picture_size
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.physics = BlockPhysics(blocks)
        self._history: list[NDArray[Any]] = []
        self._painter: BlockPainter | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Everything at its start. Nothing is random, so a seed changes nothing."""
        super().reset(seed=seed)
        self.physics.reset()
        self._history.clear()
        return self._observe(), self._info()

    def step(self, action: Floats) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Drive the agent for 0.08 s; ``action`` (2,) in [-1, 1] is its velocity over 4 m/s.

        Raises:
            RPGError: the action has another shape.
            NonFiniteError: the action is NaN or infinite.
        """
        command = checked_action(self.name, action, 2)
        self.physics.step(command)
        self._history.append(command)
        info = self._info()
        return self._observe(), float(info["success"]), False, False, info

    def render(self) -> Frame | None:
        """The scene from above, uint8 (size, size, 3), or None without a render mode."""
        if self.render_mode is None:
            return None
        return self._paint()

    def get_state(self) -> dict[str, Any]:
        """The actions since the last reset, (steps, 2) float64.

        The engine keeps contact data that SAPIEN cannot save, so positions and velocities alone continue
        equal to the last bit only nearly always. The actions always do: the start is deterministic.
        """
        return {"actions": np.array(self._history, dtype=np.float64).reshape(-1, 2)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue, bit-equal, from what :meth:`get_state` returned, by repeating those actions."""
        actions = np.array(state["actions"], dtype=np.float64)
        if actions.ndim != 2 or actions.shape[1] != 2:
            raise RPGError(
                f"{self.name}: the state's actions have shape {actions.shape}, expected (steps, 2)"
            )
        self.physics.reset()
        for action in actions:
            self.physics.step(action)
        self._history = list(actions)

    def close(self) -> None:
        """Free the physics scene."""
        self.physics.close()

    def _info(self) -> dict[str, Any]:
        offset = self.physics.goals - self.physics.position[:-1]
        in_place = int((np.einsum("ij,ij->i", offset, offset) < TOLERANCE**2).sum())
        count = len(offset)
        return {"success": in_place == count, "blocks_in_place": in_place, "score": in_place / count}

    def _paint(self) -> Frame:
        if self._painter is None:
            self._painter = BlockPainter(
                self.picture_size, self.physics.goals, HALF_SIZE, ARENA + HALF_SIZE, 2 * WALL
            )
        return self._painter.frame(self.physics.position)

    @abstractmethod
    def _observe(self) -> NDArray[Any]:
        """What the agent sees of the present state."""


class BlockPushEnv(_BlockPush):
    """Blocks and goals as numbers.

    Observation, (8 n + 6,) float32 for n blocks (22 for two): (block 1, ..., block n, agent) xy / 2; then
    0.1 times (block positions, block velocities, goal minus block, agent position, agent velocity).
    The first 2 n + 2 are the objects of interest.

    Action: (2,), velocity of the agent over 4 m/s. Reward: 1 for every step that ends with all blocks
    closer than 0.2 m to their goals, else 0; ``info["success"]`` says the same and
    ``info["blocks_in_place"]`` how many are.

    Args:
        blocks: how many, 1 to 6; the published task has 2.
        render_mode: "rgb_array" or None.
        picture_size: side of rendered frames, pixels.
    """

    def __init__(self, blocks: int = 2, render_mode: str | None = None, picture_size: int = 256) -> None:
        super().__init__(blocks, render_mode, picture_size)
        self._objects = 2 * blocks + 2
        self.observation_space = Box(-np.inf, np.inf, (self._objects + 6 * blocks + 4,), np.float32)
        self.objects_of_interest = ObjectsOfInterest.of(range(self._objects))

    def _observe(self) -> Floats:
        position, velocity = self.physics.position, self.physics.velocity
        state = np.concatenate(
            [position[:-1], velocity[:-1], self.physics.goals - position[:-1], position[-1:], velocity[-1:]]
        ).ravel()
        return np.concatenate([position.ravel() * np.float32(0.5), state * np.float32(0.1)])


class VisualBlockPushEnv(_BlockPush):
    """One block, seen from above: the observation is a picture, uint8 (size, size, 3) RGB.

    Velocities are not visible in one picture; the published task shows two consecutive ones. Action, reward
    and success are those of :class:`BlockPushEnv`.

    Args:
        blocks: how many; the published task has 1.
        render_mode: "rgb_array" or None.
        picture_size: side of the observed frame, pixels.
    """

    name = "VisualBlockPush"

    def __init__(self, blocks: int = 1, render_mode: str | None = None, picture_size: int = 64) -> None:
        super().__init__(blocks, render_mode, picture_size)
        self.observation_space = Box(0, 255, (picture_size, picture_size, 3), np.uint8)

    def _observe(self) -> Frame:
        return self._paint()
