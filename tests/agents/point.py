"""A point on a line that is to be brought to a goal: what any agent learns within seconds. And checks all share."""

from __future__ import annotations

import io
from typing import Any

import torch
from gymnasium.spaces import Box
from torch import Tensor

from rpg.agents import Agent
from rpg.segments import SegmentBatch
from rpg.training.replay import SegmentReplay

OBS, ACTION = Box(-1.0, 1.0, (1,)), Box(-2.0, 2.0, (1,))
GOAL, STEPS, POINTS = 0.5, 10, 8


def moved(x: Tensor, action: Tensor) -> Tensor:
    return (x + 0.1 * action).clamp(-1.0, 1.0)


def practise(agent: Agent, vector_steps: int, learn_from: int = 20) -> SegmentReplay:
    """Act in episodes that a time limit ends, and update once after every vector step from one on."""
    torch.manual_seed(0)
    replay = SegmentReplay(1, 1, agent.latent_dim, POINTS, 10_000)
    none = torch.zeros(POINTS)
    latent = torch.zeros(POINTS, agent.latent_dim)
    for step in range(vector_steps):
        if step % STEPS == 0:
            x = torch.rand(POINTS, 1) * 2 - 1
            latent = agent.begin_episodes(x, torch.ones(POINTS, dtype=torch.bool), latent)
        action = agent.act(x, latent)
        after = moved(x, action)
        reward = -(after[:, 0] - GOAL).square()
        replay.add(x, action, reward, after, none, none + float(step % STEPS == STEPS - 1), latent)
        x = after
        if step >= learn_from:
            agent.update(replay.sample(agent.batch_size, agent.horizon), POINTS * step)
    return replay


def distance(agent: Agent) -> float:
    """Mean distance to the goal after an episode of deterministic actions, from starts all over the line."""
    x = torch.linspace(-1.0, 1.0, 32).unsqueeze(1)
    with agent.evaluating():
        torch.manual_seed(1)
        latent = agent.begin_episodes(x, torch.ones(32, dtype=torch.bool), torch.zeros(32, agent.latent_dim))
        for _ in range(STEPS):
            x = moved(x, agent.act(x, latent, deterministic=True))
    return float((x - GOAL).abs().mean())


def batches(agent: Agent, n: int, obs_dim: int, seed: int = 1) -> list[SegmentBatch]:
    """Random experience with endings and masked steps."""
    generator = torch.Generator().manual_seed(seed)
    k, size = agent.horizon, agent.batch_size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    return [
        SegmentBatch(
            obs=uniform(size, obs_dim),
            next_obs=uniform(k, size, obs_dim),
            action=agent.to_env(2 * uniform(k, size, agent.action_dim) - 1),
            reward=uniform(k, size),
            terminated=(uniform(k, size) < 0.2).float(),
            mask=torch.cat([torch.ones(1, size), (uniform(k - 1, size) < 0.8).float().cumprod(0)]),
            latent=uniform(size, agent.latent_dim),
            step=(4 * uniform(size)).floor(),
            bonus=uniform(k, size) - 0.5,
        )
        for _ in range(n)
    ]


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict):
        return {prefix: tree}
    return {k: v for key, sub in tree.items() for k, v in flat(sub, f"{prefix}/{key}").items()}


def touched(before: Any, after: Any) -> set[str]:
    """Top-level names of entries in which two state dicts are not bit-equal."""
    a, b = flat(before), flat(after)
    assert a.keys() == b.keys()
    same = {k: torch.equal(a[k], b[k]) if isinstance(a[k], Tensor) else a[k] == b[k] for k in a}
    return {k.split("/")[1] for k, equal in same.items() if not equal}


def snapshot(state: Any) -> Any:
    """Through a file and back, as a checkpoint would."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)
