"""Reparameterized Policy Gradient: latent-variable model-based reinforcement learning."""

__version__ = "0.1.0"
