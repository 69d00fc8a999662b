"""A tiny agent and batches for it, degenerate ones and ones that can be learned."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from rpg.agents import RPG, RPGConfig, WorldModelConfig
from rpg.exploration import ObjectsOfInterest, RandomNetworkDistillation, RNDConfig
from rpg.segments import SegmentBatch

OBS, ACT = 4, 2
OBJECTS = ObjectsOfInterest.of((0, 1))


def make_agent(world_model: dict[str, Any] | None = None, **changes: Any) -> RPG:
    torch.manual_seed(0)
    model: dict[str, Any] = {"state_dim": 16, "width": 32, "lr": 1e-3} | (world_model or {})
    config: dict[str, Any] = {"batch_size": 16, "width": 32, "lr": 1e-3} | changes
    box = gym.spaces.Box(-np.inf, np.inf, (OBS,))
    actions = gym.spaces.Box(-1.0, 1.0, (ACT,))
    return RPG(box, actions, RPGConfig(world_model=WorldModelConfig(**model), **config), OBJECTS)


def make_rnd(**changes: Any) -> RandomNetworkDistillation:
    config: dict[str, Any] = {"width": 32, "batch_size": 16, "capacity": 1000, "warmup": 10} | changes
    return RandomNetworkDistillation(OBJECTS, RNDConfig(**config))


def noise_batch(agent: RPG, kind: str) -> SegmentBatch:
    """Nothing to learn: inputs that do not vary, are 0, or so large that they mean nothing, and unit normals."""
    steps, n = agent.horizon, agent.batch_size
    scale = {"constant": 0.0, "zero": 0.0, "huge": 1e10, "ordinary": 1.0}[kind]
    offset = 3.0 if kind == "constant" else 0.0
    reward_scale = 1e4 if kind == "huge" else 1.0
    return _batch(
        agent,
        torch.randn(n, OBS) * scale + offset,
        torch.randn(steps, n, OBS) * scale + offset,
        torch.rand(steps, n, ACT) * 2 - 1,
        torch.randn(steps, n) * reward_scale * (kind != "zero"),
    )


def pushed_batch(agent: RPG, offset: float = 0.0) -> SegmentBatch:
    """A point that each action pushes, and a reward for being near 0: all of it can be learned.

    ``offset`` is added to every reward, so that values grow towards offset / (1 - gamma).
    """
    obs = torch.rand(agent.batch_size, OBS) * 2 - 1
    action = torch.rand(agent.horizon, agent.batch_size, ACT) * 2 - 1
    push = torch.cat([action, action], dim=-1).cumsum(0)
    next_obs = obs + 0.2 * push
    reward = 1.0 - next_obs[..., :ACT].square().sum(-1) + offset
    return _batch(agent, obs, next_obs, action, reward)


def _batch(agent: RPG, obs: Tensor, next_obs: Tensor, action: Tensor, reward: Tensor) -> SegmentBatch:
    return SegmentBatch(
        obs=obs,
        next_obs=next_obs,
        action=action,
        reward=reward,
        terminated=torch.zeros_like(reward),
        mask=torch.ones_like(reward),
        latent=torch.randn(len(obs), agent.latent_dim),
        step=torch.ones(len(obs)),
    )


def leaves(tree: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """Every tensor of a nested state, with its path."""
    if isinstance(tree, Tensor):
        yield prefix, tree
    elif isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, f"{prefix}/{key}" if prefix else str(key))
