"""Acrobot with goals, batched (thesis Sec. 4.6.2). A reconstruction: no code was published."""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium.spaces import Discrete

from rpg.envs.goal_batch import RANDOM, GoalVectorEnv, SingleGoalEnv
from rpg.envs.maze_picture import GOAL, OTHER, Colour, Disc, MazeCanvas
from rpg.envs.streams import Floats, Integers, Mask
from rpg.errors import RPGError
from rpg.goals import GoalSpec

HANGING = "hanging"
LINE = 1.0
"""Goals have the tip above this height over the shoulder; both links are 1 long."""
MAX_SPEED = np.array([4 * np.pi, 9 * np.pi])
"""Of the joints, rad/s; what velocities are divided by in the observation."""

_DT, _GRAVITY = 0.2, 9.8
_NOISE = 0.1  # of the hanging start, uniform
_FREE_SPEED = 1.0  # rad/s, of the random start, uniform
_BANK_COPIES, _BANK_STEPS, _BANK_RANDOM = 256, 200, 0.2


def swing(state: Floats, torque: Floats) -> Floats:
    """0.2 s of Acrobot by one step of the fourth-order Runge-Kutta method, as in gymnasium's ``Acrobot-v1``.

    Links of mass, length and inertia 1, mass in the middle; equations of Sutton and Barto (2018), Sec. 11.4.

    Args:
        state: (n, 4) angle of the first link from hanging, of the second from the first, and their velocities.
        torque: (n,) at the joint between them.

    Returns:
        (n, 4), angles in [-pi, pi), velocities within :data:`MAX_SPEED`.
    """
    first = _derivative(state, torque)
    second = _derivative(state + _DT / 2 * first, torque)
    third = _derivative(state + _DT / 2 * second, torque)
    fourth = _derivative(state + _DT * third, torque)
    new = state + _DT / 6 * (first + 2 * second + 2 * third + fourth)
    angles = np.remainder(new[:, :2] + np.pi, 2 * np.pi) - np.pi
    return np.concatenate([angles, new[:, 2:].clip(-MAX_SPEED, MAX_SPEED)], axis=1)


def _derivative(state: Floats, torque: Floats) -> Floats:
    angle_1, angle_2, speed_1, speed_2 = state.T
    cosine, sine = np.cos(angle_2), np.sin(angle_2)
    inertia = 3.5 + cosine  # of both links about the shoulder
    coupling = 1.25 + 0.5 * cosine
    weight_2 = 0.5 * _GRAVITY * np.sin(angle_1 + angle_2)
    load = -0.5 * speed_2**2 * sine - speed_2 * speed_1 * sine + 1.5 * _GRAVITY * np.sin(angle_1) + weight_2
    push = torque + coupling / inertia * load - 0.5 * speed_1**2 * sine - weight_2
    pull_2 = push / (1.25 - coupling**2 / inertia)
    return np.stack([speed_1, speed_2, -(coupling * pull_2 + load) / inertia, pull_2], axis=1)


def observed(state: Floats) -> Floats:
    """Cosine and sine of both angles and scaled velocities, (n, 6) in [-1, 1], of states (n, 4)."""
    angle_1, angle_2 = state[:, 0], state[:, 1]
    turned = [np.cos(angle_1), np.sin(angle_1), np.cos(angle_2), np.sin(angle_2)]
    return np.concatenate([np.stack(turned, axis=1), state[:, 2:] / MAX_SPEED], axis=1)


def above_line(state: Floats) -> Mask:
    """Whether the tip is above :data:`LINE`, (n,), in states (n, 4)."""
    height: Floats = -np.cos(state[:, 0]) - np.cos(state[:, 0] + state[:, 1])
    return height > LINE


class Swings(NamedTuple):
    """Recorded episodes of a policy that pumps energy: states (T + 1, n, 4), actions (T, n)."""

    states: Floats
    actions: Integers


@cache
def record_swings() -> Swings:
    """Episodes from hanging, whose torque follows the second joint's velocity but for random actions now and then."""
    rng = np.random.default_rng(0)
    state = rng.uniform(-_NOISE, _NOISE, (_BANK_COPIES, 4))
    states, actions = [state], []
    for _ in range(_BANK_STEPS):
        action = 1 + np.sign(state[:, 3]).astype(np.int64)
        chance = rng.uniform(size=_BANK_COPIES) < _BANK_RANDOM
        action = np.where(chance, rng.integers(0, 3, _BANK_COPIES), action)
        state = swing(state, action.astype(np.float64) - 1.0)
        states.append(state)
        actions.append(action)
    return Swings(np.stack(states), np.stack(actions))


@cache
def goal_bank() -> Floats:
    """Goals to draw from, (n, 6): the recorded states with the tip above the line, so each can be reached."""
    states = record_swings().states.reshape(-1, 4)
    bank = observed(states[above_line(states)])
    bank.flags.writeable = False
    return bank


class AcrobotGoalVectorEnv(GoalVectorEnv):
    """Acrobots that shall pass through given angles and velocities with the tip above the line.

    State and goal: cosine and sine of both angles, velocities over :data:`MAX_SPEED`: six numbers in [-1, 1].
    Action: 0, 1, 2, a torque of -1, 0, 1 for 0.2 s. Goals are drawn from :func:`goal_bank`. ``options`` of ``reset``:
    ``start`` (num_envs, 4), angles and velocities; ``goal`` (num_envs, 6).

    Args:
        num_envs: number of Acrobots.
        start: "random", any angles, velocities up to 1 rad/s; or "hanging", angles and velocities up to 0.1.
        episode_steps: steps to an episode.
        relabel_radius: see :class:`rpg.goals.GoalSpec`.
        success_radius: the same. A step turns a fast link by half a radian, so even a way through the very goal
            passes it at some distance; hence more than the published 0.03.
        reward: "sparse" or "dense".
        render_mode: "rgb_array" or None.

    Raises:
        RPGError: an argument outside its range.
    """

    name = "acrobot_goal"
    option_dims = {"start": 4, "goal": 6}  # noqa: RUF012 (a constant of the class)

    def __init__(
        self,
        num_envs: int = 1,
        start: str = RANDOM,
        episode_steps: int = 200,
        relabel_radius: float = 0.03,
        success_radius: float = 0.3,
        reward: str = "sparse",
        render_mode: str | None = None,
    ) -> None:
        if start not in (RANDOM, HANGING):
            raise RPGError(f"{self.name}: start {start!r} is unknown; use '{RANDOM}' or '{HANGING}'")
        spec = GoalSpec.of(6, range(6), relabel_radius, success_radius)
        low, high = np.full(6, -1.0), np.ones(6)
        super().__init__(num_envs, spec, low, high, Discrete(3), episode_steps, reward, render_mode, 4)
        self._reach = np.full(4, _NOISE)
        if start == RANDOM:
            self._reach = np.array([np.pi, np.pi, _FREE_SPEED, _FREE_SPEED])

    def _begin(self, rows: Integers, start: Floats | None, goal: Floats | None) -> None:
        drawn = self._streams.uniform(rows, 5)
        bank = goal_bank()
        self._state[rows] = self._reach * (2 * drawn[:, :4] - 1) if start is None else start
        self._goal[rows] = bank[(drawn[:, 4] * len(bank)).astype(np.int64)] if goal is None else goal

    def _advance(self, actions: Integers) -> None:
        self._state = swing(self._state, actions.astype(np.float64) - 1.0)

    def _seen(self) -> Floats:
        return observed(self._state)

    def _make_canvas(self) -> MazeCanvas:
        return MazeCanvas(np.array([(-2.2, LINE, 2.2, LINE)]), 2.2)

    def _drawn(self, env: int) -> tuple[Floats, list[Disc]]:
        goal = self._goal[env]
        aim = np.array([np.arctan2(goal[1], goal[0]), np.arctan2(goal[3], goal[2])])
        _, wanted = _links(aim, GOAL)
        tip, links = _links(self._state[env, :2], OTHER)
        return tip, wanted + links


def _links(angles: Floats, colour: Colour) -> tuple[Floats, list[Disc]]:
    """The tip, and both links as rows of discs."""
    shoulder = np.zeros(2)
    elbow = np.array([np.sin(angles[0]), -np.cos(angles[0])])
    tip = elbow + np.array([np.sin(angles.sum()), -np.cos(angles.sum())])
    places = [
        a + share * (b - a) for a, b in ((shoulder, elbow), (elbow, tip)) for share in np.linspace(0, 1, 12)
    ]
    return tip, [(colour, place, 0.07) for place in places]


class AcrobotGoalEnv(SingleGoalEnv):
    """:class:`AcrobotGoalVectorEnv` with a batch of one."""

    batch: ClassVar[type[Any]] = AcrobotGoalVectorEnv
