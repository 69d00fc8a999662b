"""Fig. 3.4: RPG leaves the local optimum of the one-dimensional bandit, a Gaussian policy does not.

    python scripts/figure_bandit.py                 # train 20 seeds of both methods, write and draw
    python scripts/figure_bandit.py --study         # and count successes of two variants of the latent policy
    python scripts/figure_bandit.py --redraw        # draw again from what is saved, in seconds

Writes to ``--out``: ``final.csv`` (one row for each method and seed), ``curves.csv`` (reward and mass of the
global mode along training), ``policy.csv`` (the exact density of the seed shown: weight, mean and log-std of
each latent's tanh-normal), ``run.json`` (how it was made) and ``figure_3_4.png``.
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rpg.bandit import BanditConfig, BanditResult, TanhNormalMixture, train_gaussian, train_rpg
from rpg.envs.bandit import bandit_reward
from rpg.errors import RPGError

METHODS = ("rpg", "gaussian")
TITLES = {"rpg": "RPG", "gaussian": "Gaussian"}
COLOURS = {"rpg": "#c1272d", "gaussian": "#2a5caa"}
LATENT_COLOURS = ("#c1272d", "#e8833a", "#f2c14e", "#8c4a8f", "#4b8f8c", "#6b6b6b", "#a3b18a", "#1b4965")
PANELS = (0.0, 0.375, 0.5, 0.625, 0.75, 1.0)
"""Where in training the columns of the figure stand, as fractions of all updates."""
TRAJECTORY = ("method", "step", "latent", "weight", "mean", "log_std")


def main(argv: Sequence[str] | None = None) -> int:
    """Parse, run or load, draw. Returns the exit code: 2 after a user error, printed in one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="train seeds 0 .. SEEDS-1")
    parser.add_argument("--steps", type=int, default=12_000, help="updates")
    parser.add_argument("--out", type=Path, default=Path("results/bandit"), help="folder for data and figure")
    parser.add_argument("--show-seed", type=int, default=0, help="seed whose densities are drawn")
    parser.add_argument("--redraw", action="store_true", help="draw from the data in --out, train nothing")
    parser.add_argument("--study", action="store_true", help="also train the variants listed in docs/bandit.md")
    args = parser.parse_args(argv)
    try:
        if not args.redraw:
            run(args)
        draw(args.out)
    except RPGError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
