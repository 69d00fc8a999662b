"""Small worlds in which the right distance is known."""

from __future__ import annotations

import torch
from torch import Tensor

from rpg.goals import GoalSpec
from rpg.landmarks import LandmarkPlanner, PlannerConfig

SPEC = GoalSpec(state_dim=3, achieved=(2, 0), relabel_radius=0.1, success_radius=1.0)
"""States (y, something else, x), goals (x, y)."""


def states_at(places: Tensor) -> Tensor:
    """States (n, 3) at places (n, 2)."""
    return torch.stack([places[:, 1], torch.zeros(len(places)), places[:, 0]], dim=1)


def straight(state: Tensor, goal: Tensor) -> Tensor:
    """One step a unit, nothing in the way."""
    return (SPEC.achieved_goal(state) - goal).norm(dim=1)


def uphill(state: Tensor, goal: Tensor) -> Tensor:
    """One step a unit, and one more for each unit upwards: it depends on the direction."""
    return straight(state, goal) + (goal[:, 1] - SPEC.achieved_goal(state)[:, 1]).clamp_min(0)


def planner_of(places: Tensor, distance: object = straight, **settings: object) -> LandmarkPlanner:
    """A planner whose candidates are at places (n, 2)."""
    chosen = {"landmarks": len(places), "candidates": len(places)} | settings
    planner = LandmarkPlanner(SPEC, PlannerConfig(**chosen), "cpu")  # type: ignore[arg-type]
    planner.rebuild(states_at(places), distance)  # type: ignore[arg-type]
    return planner
