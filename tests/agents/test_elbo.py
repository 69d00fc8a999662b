"""Eq. 3.2 by brute force on a toy with 3 latents, 4 states, 4 actions and 2 steps.

An episode starts in state 0 and goes on in state NEXT[a1]. Optimality given a trajectory is exp(R / T) and
actions are uniform a priori, so log p(O) = log sum_tau exp(R(tau) / T) - 2 log 4, up to the normaliser of
exp(R / T). The bound leaves the constant -2 log 4 of the action prior out, and so does OPTIMUM below.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from rpg.policies import LatentConfig, LatentPosterior, make_latent_space
from rpg.world_model.rollout import Imagined, shaped_reward

LATENTS, STATES, ACTIONS = 3, 4, 4
TEMPERATURE = 0.5
NEXT = torch.tensor([1, 2, 3, 3])
REWARD = torch.tensor(
    [[0.3, 1.0, -0.5, 0.9], [0.1, 0.8, 0.2, -1.0], [0.0, 0.4, 1.2, 1.1], [0.6, -0.2, 0.5, 0.0]],
    dtype=torch.float64,
)
# Weight of each first action when all that can follow it is summed up, and of all trajectories.
FIRST = REWARD[0] / TEMPERATURE + (REWARD / TEMPERATURE).logsumexp(1)[NEXT]
OPTIMUM = float(FIRST.logsumexp(0))  # log sum_tau exp(R / T)

# Every (z, a1, a2) and the states passed.
Z, A1, A2 = torch.tensor(list(itertools.product(range(LATENTS), range(ACTIONS), range(ACTIONS)))).T
S1, S2 = torch.zeros_like(A1), NEXT[A1]


class Tables(NamedTuple):
    """pi(z); pi(a|s, z), indexed [s, z, a]; log p_phi(z|s, a), indexed [s, a, z]."""

    prior: Tensor
    policy: Tensor
    log_posterior: Tensor


class TablePosterior:
    """LatentPosterior for one-hot states and actions; log p_phi is looked up."""

    def __init__(self, table: Tensor) -> None:
        self.table = table

    def log_prob(self, state: Tensor, action: Tensor, latent: Tensor) -> Tensor:
        return (self.table[state.argmax(-1), action.argmax(-1)] * latent).sum(-1)


class SpacePosterior(TablePosterior):
    """The same, with the table as logits of the package's categorical space."""

    def log_prob(self, state: Tensor, action: Tensor, latent: Tensor) -> Tensor:
        space = make_latent_space(LatentConfig(gaussian=0, categories=LATENTS, smoothing=0.0))
        return space.log_posterior(self.table[state.argmax(-1), action.argmax(-1)], latent)


def joint(tables: Tables) -> Tensor:
    """pi(z, tau) of every combination."""
    return tables.prior[Z] * tables.policy[S1, Z, A1] * tables.policy[S2, Z, A2]


def bound(tables: Tables, posterior: Any = TablePosterior) -> float:
    """E[sum r/T + log p_phi(z|s, a) - log pi(a|s, z), minus log pi(z)], by enumeration."""
    imagined = Imagined(
        states=torch.eye(STATES)[torch.stack([S1, S2, S2])],
        actions=torch.eye(ACTIONS)[torch.stack([A1, A2])],
        log_pi=torch.stack([tables.policy[S1, Z, A1], tables.policy[S2, Z, A2]]).log(),
        rewards=torch.stack([REWARD[S1, A1], REWARD[S2, A2]]) / TEMPERATURE,
        bootstrap=torch.zeros(2, 2, len(Z)),
    )
    one = torch.tensor(1.0)
    per_step = shaped_reward(
        imagined, torch.eye(LATENTS).double()[Z], posterior(tables.log_posterior), one, one
    )
    weight = joint(tables)
    possible = weight > 0  # 0 log 0 = 0
    return float((weight * (per_step.sum(0) - tables.prior[Z].log()))[possible].sum())


def random_tables(seed: int) -> Tables:
    torch.manual_seed(seed)
    return Tables(
        torch.randn(LATENTS).double().softmax(0),
        (2 * torch.randn(STATES, LATENTS, ACTIONS)).double().softmax(-1),
        torch.randn(STATES, ACTIONS, LATENTS).double().log_softmax(-1),
    )


def optimal_tables(responsibility: Tensor) -> Tables:
    """A policy whose trajectories follow p(tau|O), in which z, given a1, has ``responsibility`` [a1, z].

    The posterior is the true one: pi(z|tau) = pi(z|a1) is told at the first step, the second adds nothing.
    """
    both = FIRST.softmax(0).unsqueeze(1) * responsibility  # (a1, z)
    prior = both.sum(0)
    policy = (REWARD / TEMPERATURE).softmax(-1).unsqueeze(1).repeat(1, LATENTS, 1)
    policy[0] = (both / prior).T
    table = torch.zeros(STATES, ACTIONS, LATENTS, dtype=torch.float64)
    table[0] = responsibility.log()
    return Tables(prior, policy, table)


def any_responsibility() -> Tensor:
    torch.manual_seed(0)
    return torch.randn(ACTIONS, LATENTS).double().softmax(-1)


def test_is_a_lower_bound_whatever_the_policy_and_posterior() -> None:
    bounds = [bound(random_tables(seed), SpacePosterior) for seed in range(200)]
    assert max(bounds) < OPTIMUM


def test_is_tight_for_the_optimal_policy_and_the_true_posterior() -> None:
    tables = optimal_tables(any_responsibility())
    assert float(joint(tables).sum()) == pytest.approx(1.0)
    assert bound(tables) == pytest.approx(OPTIMUM, abs=1e-9)


def test_is_tight_when_z_names_the_mode_that_every_step_shows() -> None:
    # Three groups of first actions, and each leads to a state of its own: s and a give z away at both steps.
    group = torch.tensor([0, 1, 2, 2])
    tables = optimal_tables(torch.eye(LATENTS, dtype=torch.float64)[group])
    told = torch.zeros(STATES, ACTIONS, LATENTS, dtype=torch.float64)
    told[0] = torch.eye(LATENTS)[group]
    for z in range(LATENTS):
        told[z + 1, :, z] = 1.0
    tables = tables._replace(log_posterior=told.log())
    assert bound(tables, SpacePosterior) == pytest.approx(OPTIMUM, abs=1e-9)


def test_a_wrong_posterior_costs_its_kl_divergence() -> None:
    tables = optimal_tables(any_responsibility())
    wrong = torch.full((ACTIONS, LATENTS), 1 / LATENTS, dtype=torch.float64).log()
    true = tables.log_posterior[0]
    divergence = float((FIRST.softmax(0) * (true.exp() * (true - wrong)).sum(-1)).sum())
    table = tables.log_posterior.clone()
    table[0] = wrong
    assert divergence > 0.1
    assert bound(tables._replace(log_posterior=table)) == pytest.approx(OPTIMUM - divergence, abs=1e-9)


def test_a_greedy_policy_scores_below_the_optimum() -> None:
    tables = optimal_tables(any_responsibility())
    sharper = tables.policy.clone()
    sharper[1:] = (3 * REWARD[1:] / TEMPERATURE).softmax(-1).unsqueeze(1)
    assert bound(tables._replace(policy=sharper)) < OPTIMUM - 0.05


def hand_built() -> tuple[Imagined, Tensor, LatentPosterior]:
    torch.manual_seed(0)
    space = make_latent_space(LatentConfig(gaussian=0, categories=LATENTS))
    posterior = LatentPosterior(state_dim=5, action_dim=2, space=space, width=8)
    steps, n = 2, 6
    imagined = Imagined(
        states=torch.randn(steps + 1, n, 5),
        actions=torch.rand(steps, n, 2),
        log_pi=torch.randn(steps, n),
        rewards=torch.randn(steps, n),
        bootstrap=torch.randn(2, steps, n),
    )
    return imagined, space.sample(space.prior_params(n)), posterior


def test_shaped_reward_is_reward_minus_log_pi_plus_log_posterior_per_step() -> None:
    imagined, latent, posterior = hand_built()
    shaped = shaped_reward(imagined, latent, posterior, torch.tensor(0.2), torch.tensor(3.0))
    for t in range(2):
        for i in range(6):
            log_p = posterior.log_prob(imagined.states[t, i], imagined.actions[t, i], latent[i])
            expected = imagined.rewards[t, i] - 0.2 * imagined.log_pi[t, i] + 3.0 * log_p
            torch.testing.assert_close(shaped[t, i], expected)


def test_shaped_reward_leaves_out_terms_without_a_weight() -> None:
    imagined, latent, posterior = hand_built()
    alpha = torch.tensor(0.2)
    assert torch.equal(shaped_reward(imagined, latent, posterior, None, None), imagined.rewards)
    entropy_only = imagined.rewards - 0.2 * imagined.log_pi
    torch.testing.assert_close(shaped_reward(imagined, latent, None, alpha, torch.tensor(3.0)), entropy_only)
