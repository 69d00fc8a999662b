"""Replay, runner and trainer. Importing this package loads neither Hydra nor a logger's vendor."""

from rpg.training.replay import SegmentReplay
from rpg.training.runner import Runner, evaluate
from rpg.training.trainer import Trainer

__all__ = ["Runner", "SegmentReplay", "Trainer", "evaluate"]
