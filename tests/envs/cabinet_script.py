"""A scripted hand that opens the cabinet's doors: proof that the tasks can be solved, and states worth testing.

With the upper arm as it starts, joints 2, 4 and 6 move the hand in the horizontal plane of the handles. The
script hooks the closed fingers behind a handle, pulls, and pushes door 0 on from the inside. Its numbers were
found by trying; lengths in m, angles in rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rpg.envs.sapien import cabinet_model as model
from rpg.envs.sapien.cabinet import CabinetPhysics

JOINTS = [1, 3, 5]
LOW, HIGH = np.array([-1.76, -3.07, -0.01]), np.array([1.76, -0.07, 3.745])
STEP = 1 / model.CONTROL_FREQ


def turned(angle: float, x: float, y: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([cos * x - sin * y, sin * x + cos * y])


def on_door(door: int, angle: float, outward: float, from_hinge: float) -> np.ndarray:
    """x, y of a point of a door at ``angle``."""
    side = model.DOOR_SIDE[door]
    return np.array([model.HINGE_X, side * model.WIDTH / 2]) + turned(
        -side * angle, -outward, -side * from_hinge
    )


def handle(door: int, angle: float) -> np.ndarray:
    return on_door(door, angle, -model.HANDLE_X, model.HANDLE_Y)


class PlanarArm:
    """Where the hand is, and joint velocities that take it elsewhere; ``base`` is x, y, yaw of the robot."""

    def __init__(self) -> None:
        self.copy = CabinetPhysics(mobile=False, sim_freq=model.CONTROL_FREQ)
        self.tip_link = next(link for link in self.copy.robot.links if link.name == "right_panda_hand_tcp")

    def tip(self, arm: np.ndarray, base: np.ndarray) -> np.ndarray:
        """x, y and yaw of the point between the fingertips."""
        qpos = np.concatenate([arm, [0.0, 0.0]]).astype(np.float32)
        self.copy.robot.set_qpos(qpos)
        pose = self.tip_link.entity_pose
        ahead = pose.to_transformation_matrix()[:3, 2]
        place = base[:2] + turned(base[2], *(pose.p[:2].astype(float) - model.FIXED_BASE))
        return np.array([*place, base[2] + math.atan2(ahead[1], ahead[0])])

    def velocities(
        self, arm: np.ndarray, base: np.ndarray, wish: np.ndarray, yaw_weight: float
    ) -> np.ndarray:
        """Joint velocities (7,) for a wished velocity of the tip (x, y, yaw), within joint limits."""
        here = self.tip(arm, base)
        jacobian = np.zeros((3, 3))
        for column, joint in enumerate(JOINTS):
            moved = arm.copy()
            moved[joint] += 1e-3
            jacobian[:, column] = (self.tip(moved, base) - here) / 1e-3
        weight = np.array([1.0, 1.0, yaw_weight])
        rows, goal, free = jacobian * weight[:, None], wish * weight, np.ones(3)
        for _ in range(3):
            used = rows * free
            speed = used.T @ np.linalg.solve(used @ used.T + 9e-4 * np.eye(3), goal)
            after = arm[JOINTS] + STEP * speed
            free = free * ~(((after < LOW) & (speed < 0)) | ((after > HIGH) & (speed > 0)))
        velocity = 4 * (np.array(model.START_ARM) - arm)
        velocity[JOINTS] = speed
        return velocity * min(1.0, 3.14 / max(np.abs(speed).max(), 1e-9))


@dataclass
class Move:
    """What to do now: where the tip should go, how it should point, and when that is enough."""

    target: np.ndarray
    yaw: float
    near: float = 0.0
    patience: int = 99
    done: bool = False
    yaw_weight: float = 0.05
    gain: float = 12.0
    yaw_gain: float = 8.0


class Way(NamedTuple):
    """How to open door 0: places relative to its handle where not said otherwise."""

    base: tuple[float, float]
    wait: tuple[float, float]  # while the base drives
    approach: tuple[float, float]
    enter: tuple[float, float]
    hook: tuple[float, float]
    pull: tuple[float, float]  # in the frame of the door
    pulled: float  # angle from which on the door is pushed
    leave: tuple[float, float]  # outwards from the door's free edge, and beyond it
    inside: tuple[float, float]  # absolute
    yaw: float
    yaw_weight: float
    ahead: float  # of the door, when pushing


FROM_A_FIXED_BASE = Way(
    base=model.FIXED_BASE,
    wait=(0.0, 0.0),
    approach=(-0.023, -0.068),
    enter=(0.03, -0.081),
    hook=(0.025, 0.009),
    pull=(-0.107, 0.072),
    pulled=0.304,
    leave=(0.009, 0.035),
    inside=(-0.293, 0.02),
    yaw=0.797,
    yaw_weight=0.103,
    ahead=0.74,
)
DRIVING = Way(
    base=(-1.204, 0.13),
    wait=(-0.142, -0.061),
    approach=(-0.047, -0.048),
    enter=(0.048, 0.002),
    hook=(0.037, -0.004),
    pull=(-0.108, 0.101),
    pulled=0.355,
    leave=(0.043, 0.035),
    inside=(-0.308, 0.016),
    yaw=0.807,
    yaw_weight=0.141,
    ahead=0.67,
)


class Script:
    """Opens ``doors`` one after the other, each up to ``angle``.

    Args:
        physics: of the environment that is acted in; read only.
        doors: their order.
        angle: where a door counts as done.
    """

    def __init__(self, physics: Any, doors: tuple[int, ...], angle: float) -> None:
        self.physics, self.angle = physics, angle
        self.arm = PlanarArm()
        ways = {
            0: ("approach", "enter", "hook", "pull", "leave", "inside", "push"),
            1: ("retreat", "approach", "enter", "hook", "drag"),
        }
        self.plan = [(name, door) for door in doors for name in ways[door]]
        self.way = DRIVING if physics.mobile else FROM_A_FIXED_BASE
        if physics.mobile:
            self.plan.insert(0, ("wait", 0))
        self.waited, self.last = 0, 0.0

    def action(self) -> np.ndarray:
        """The next action of the environment; zero velocities once all is done."""
        qpos = np.asarray(self.physics.robot.qpos, dtype=float)
        mobile = self.physics.mobile
        base = qpos[:3] if mobile else np.array([*model.FIXED_BASE, 0.0])
        joints = qpos[4:11] if mobile else qpos[:7]
        drive = self._drive(base) if mobile else np.zeros(0)
        tip = self.arm.tip(joints, base)
        move = self._next(tip)
        velocity = np.zeros(7)
        if move is not None:
            wish = move.gain * (move.target - tip[:2])
            wish *= min(1.0, 2.5 / max(float(np.linalg.norm(wish)), 1e-9))
            if mobile:
                wish -= self.physics.robot.qvel[:2]
            turn = np.clip(move.yaw_gain * (move.yaw - tip[2]), -4, 4)
            velocity = self.arm.velocities(joints, base, np.array([*wish, turn]), move.yaw_weight) / 3.14
        return np.concatenate([drive, velocity, [-1.0]]).clip(-1, 1).astype(np.float32)

    def _drive(self, base: np.ndarray) -> np.ndarray:
        offset = turned(-base[2], *(np.array(self.way.base) - base[:2]))
        return np.array([*(20 * offset), -5 * base[2] / 3.14, 0.0])

    def _next(self, tip: np.ndarray) -> Move | None:
        while self.plan:
            name, door = self.plan[0]
            angle = float(self.physics.cabinet.qpos[door])
            move: Move = getattr(self, f"_door{door}")(name, angle)
            reached = float(np.linalg.norm(tip[:2] - move.target)) < move.near
            if not (move.done or reached or self.waited > move.patience):
                self.waited += 1
                self.last = angle
                return move
            self.plan.pop(0)
            self.waited = 0
        return None

    def _door0(self, name: str, angle: float) -> Move:
        way, grip = self.way, handle(0, angle)
        if name == "wait":
            away = float(np.linalg.norm(self.physics.robot.qpos[:2] - np.array(way.base)))
            return Move(grip + np.array(way.wait), way.yaw, done=away < 0.125, yaw_weight=0.12)
        if name == "pull":
            stuck = self.waited > 3 and angle - self.last < 0.01
            return Move(grip + turned(-angle, *way.pull), way.yaw, done=angle > way.pulled or stuck)
        if name == "leave":
            beside = on_door(0, angle, way.leave[0], model.DOOR_WIDTH + way.leave[1])
            return Move(beside, way.yaw, near=0.03, patience=7)
        if name == "inside":
            return Move(np.array(way.inside), way.yaw, near=0.035, patience=8)
        if name == "push":
            ahead = on_door(0, min(angle + way.ahead, 2.2), -0.048, model.DOOR_WIDTH)
            return Move(ahead, yaw=2.516, yaw_weight=0.116, gain=18.9, done=angle > self.angle)
        near, patience = {"approach": (0.05, 15), "enter": (0.035, 5), "hook": (0.022, 4)}[name]
        offset = np.array(getattr(way, name))
        return Move(grip + offset, way.yaw, near=near, patience=patience, yaw_weight=way.yaw_weight)

    def _door1(self, name: str, angle: float) -> Move:
        grip, yaw = handle(1, angle), 1.093
        if name == "retreat":
            return Move(np.array([-0.46, -0.16]), yaw, near=0.07, patience=20, yaw_weight=0.12)
        if name == "approach":
            return Move(grip + np.array([-0.075, -0.113]), yaw, near=0.05, patience=14, yaw_weight=0.12)
        if name == "enter":
            return Move(grip + np.array([0.025, -0.065]), yaw, near=0.035, patience=5, yaw_weight=0.103)
        if name == "hook":
            return Move(grip + np.array([0.035, 0.025]), yaw, near=0.022, patience=4, yaw_weight=0.103)
        pulled = grip + turned(angle, -0.09, 0.006)
        done = angle > self.angle
        return Move(pulled, yaw + angle + 0.15, yaw_weight=0.25, yaw_gain=5.975, done=done)
