"""What an update costs, in floating-point operations."""

from __future__ import annotations

from torch.utils.flop_counter import FlopCounterMode

from rpg.training.trainer import Trainer

_UPDATES = 4  # whole cycles of what happens every 2 or 4 updates, as the policy


def gflop_per_update(trainer: Trainer) -> float:
    """Billions of floating-point operations of one update: bonus predictor, relabelling, model, policy.

    Torch counts the matrix products while they run, forwards and backwards, over 4 updates. Compiled regions
    are hidden from it, so the trainer must be eager (``compile=false``).

    Args:
        trainer: of an agent that learns; it is started and collects its seed decisions if it has none yet,
            and it has learned when this returns.
    """
    if not trainer.decisions:
        trainer.start()
    bonus = trainer.exploration
    while trainer.decisions <= trainer.config.seed_decisions or (bonus is not None and not bonus.ready):
        trainer.collect_once()
    with FlopCounterMode(display=False) as counter:
        for _ in range(_UPDATES):
            trainer.learn_once()
    return float(counter.get_total_flops()) / _UPDATES / 1e9
