"""Latent spaces, the latent-conditioned policy and its action distributions."""

from rpg.policies.config import CEMConfig, PolicyConfig
from rpg.policies.heads import ActionDistribution, make_head
from rpg.policies.latent import LatentConfig, LatentSpace, make_latent_space
from rpg.policies.policy import LatentPolicy, LatentPosterior
from rpg.policies.tanh_flow import Coupling, TanhFlow
from rpg.policies.tanh_mixture import TanhMixture
from rpg.policies.tanh_normal import TanhNormal

__all__ = [
    "ActionDistribution",
    "CEMConfig",
    "Coupling",
    "LatentConfig",
    "LatentPolicy",
    "LatentPosterior",
    "LatentSpace",
    "PolicyConfig",
    "TanhFlow",
    "TanhMixture",
    "TanhNormal",
    "make_head",
    "make_latent_space",
]
