"""How true an agent's distances are, where the environment knows the fewest steps between its states."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from rpg.agents.agent import Agent
from rpg.envs.base import KnownDistances
from rpg.goals import goal_spec_of


def distance_errors(agent: Agent, envs: Any) -> dict[str, float | int | str]:
    """Mean distortion and largest distance of all pairs of states (thesis Sec. 4.6.1, Fig. 4.2b and c).

    Args:
        agent: to be asked, after it was judged, so that a planner has its map.
        envs: the environments; no :class:`rpg.envs.base.KnownDistances` gives no numbers.

    Returns:
        ``eval/<mode>/distortion``, the mean of |D - D_true| / D_true, and ``eval/<mode>/max_distance`` in steps,
        for each kind of distance that the agent has.
    """
    if not isinstance(envs, KnownDistances):
        return {}
    true = envs.distances()
    start, goal = np.nonzero(true > 0)
    states = torch.as_tensor(envs.states, dtype=torch.float32, device=agent.device)
    spec = goal_spec_of(envs)
    obs = spec.join(states[start], spec.achieved_goal(states)[goal])
    steps = torch.as_tensor(true[start, goal], dtype=torch.float32, device=agent.device)
    numbers: dict[str, float | int | str] = {}
    for mode, found in agent.distances(obs).items():
        numbers[f"eval/{mode}/distortion"] = float(((found - steps).abs() / steps).mean())
        numbers[f"eval/{mode}/max_distance"] = float(found.max())
    return numbers
