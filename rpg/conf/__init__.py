"""Hydra configuration: config.yaml and its groups."""
