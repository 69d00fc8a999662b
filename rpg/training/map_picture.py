"""Pictures of a goal-conditioned agent's map while it is trained (thesis Fig. 4.2a, 4.6c)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv

from rpg.agents.agent import Agent
from rpg.agents.goal import GoalAgent
from rpg.attributes import declared


def map_picture(agent: Agent, envs: VectorEnv[Any, Any, Any], seed: int) -> np.ndarray | None:
    """The map as an evaluation would build it now, and the way that it plans from a start to its goal.

    Args:
        agent: one with a planner and experience; any other has no picture.
        envs: those of evaluation; reset here. Walls are drawn if they declare ``wall_segments``; goals that are not
            places in the plane need ``places``, from goals (n, G) to (n, 2).
        seed: of the first environment's start and goal.

    Returns:
        uint8 (H, W, 3) RGB, or None.
    """
    if not isinstance(agent, GoalAgent) or agent.judging_planner is None:
        return None
    places = getattr(envs, "places", None)
    if agent.spec.goal_dim > 3 and places is None:
        return None
    devices = [agent.device] if agent.device.type == "cuda" else []
    with agent.evaluating(), torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        observations, _ = envs.reset(seed=[seed + i for i in range(envs.num_envs)])  # type: ignore[arg-type]
        obs = torch.as_tensor(np.asarray(observations, dtype=np.float32), device=agent.device)
        everywhere = torch.ones(len(obs), dtype=torch.bool, device=agent.device)
        agent.begin_episodes(obs, everywhere, obs.new_zeros(len(obs), 0))
        if not agent.judging_planner.ready:
            return None
        from rpg.landmarks.picture import draw_map  # which loads matplotlib

        state, goal = agent.spec.split(obs[0])
        walls = declared(envs, "wall_segments")
        return draw_map(
            agent.judging_planner, agent.distance, state, goal, () if walls is None else walls, places
        )
