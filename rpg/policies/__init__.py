"""Latent spaces, the latent-conditioned policy and its action distribution."""

from rpg.policies.latent import LatentConfig, LatentSpace, make_latent_space
from rpg.policies.policy import LatentPolicy, LatentPosterior
from rpg.policies.tanh_normal import TanhNormal

__all__ = [
    "LatentConfig",
    "LatentPolicy",
    "LatentPosterior",
    "LatentSpace",
    "TanhNormal",
    "make_latent_space",
]
