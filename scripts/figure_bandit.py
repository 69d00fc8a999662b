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
import shlex
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
from rpg.cli import report_errors
from rpg.envs.bandit import GLOBAL_HALF_WIDTH, GLOBAL_PEAK, bandit_reward
from rpg.errors import RPGError

METHODS = ("rpg", "gaussian")
TITLES = {"rpg": "RPG", "gaussian": "Gaussian"}
COLOURS = {"rpg": "#c1272d", "gaussian": "#2a5caa"}
LATENT_COLOURS = ("#c1272d", "#e8833a", "#f2c14e", "#8c4a8f", "#4b8f8c", "#6b6b6b", "#a3b18a", "#1b4965")
PANELS = (0.0, 0.125, 0.375, 0.5, 0.625, 1.0)
"""Where in training the columns of the figure stand, as fractions of all updates."""
FLAT_DENSITY = 2.0
"""Densities that stay below this share one scale; higher ones are scaled to their own peak."""
CAPTION = (
    "grey: reward landscape.  colour: density of the action, scaled to its peak; "
    "for RPG, one colour for each value of the latent z"
)
TRAJECTORY = ("method", "step", "latent", "weight", "mean", "log_std")


def main(argv: Sequence[str] | None = None) -> int:
    """Parse, run or load, draw. Returns the exit code: 2 after a user error, printed in one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20, help="train seeds 0 .. SEEDS-1")
    parser.add_argument("--steps", type=int, default=12_000, help="updates")
    parser.add_argument("--out", type=Path, default=Path("results/bandit"), help="folder for data and figure")
    parser.add_argument("--show-seed", type=int, default=0, help="seed whose densities are drawn")
    parser.add_argument("--redraw", action="store_true", help="draw from the data in --out, train nothing")
    parser.add_argument(
        "--study", action="store_true", help="also train the variants listed in docs/bandit.md"
    )
    args = parser.parse_args(argv)
    with report_errors():
        if not args.redraw:
            run(args)
        draw(args.out)
    return 0


def run(args: argparse.Namespace) -> None:
    """Train both methods and the notebook's settings, and write every file but the figure to ``args.out``.

    Raises:
        RPGError: a setting out of range, or a folder that cannot be written.
    """
    if args.seeds < 1 or not 0 <= args.show_seed < args.seeds:
        raise RPGError(f"--seeds {args.seeds}, --show-seed {args.show_seed}: need 0 <= show-seed < seeds")
    torch.set_num_threads(1)  # the tensors are small: a second thread costs more than it brings
    config = BanditConfig(steps=args.steps, log_every=max(1, args.steps // 80))
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RPGError(f"--out {args.out}: {error.strerror}; name a folder that can be written") from error

    seeds = range(args.seeds)
    results, wall_seconds = {}, {}
    for method, train in (("rpg", train_rpg), ("gaussian", train_gaussian)):
        results[method], wall_seconds[method] = timed(train, config, seeds)
    published = replace(config, gradient="pathwise")
    published_result, wall_seconds["published_settings"] = timed(train_rpg, published, seeds)

    record: dict[str, Any] = {
        "command": shlex.join(["python", *sys.argv]),
        "commit": commit(),
        "seeds": list(seeds),
        "shown_seed": args.show_seed,
        "machine": cpu_name(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "wall_seconds": wall_seconds,
        "settings": asdict(config),
        **{method: summary(result) for method, result in results.items()},
        "published_settings": {"differs_in": {"gradient": "pathwise"}, **summary(published_result)},
    }
    if args.study:
        record["study"] = study(config, seeds)
    (args.out / "run.json").write_text(json.dumps(record, indent=2) + "\n")
    write_csv(args.out / "final.csv", final_rows(results))
    write_csv(args.out / "curves.csv", curve_rows(results))
    write_csv(args.out / "policy.csv", policy_rows(results, args.show_seed))


def timed(
    train: Callable[[BanditConfig, Sequence[int]], BanditResult], config: BanditConfig, seeds: Sequence[int]
) -> tuple[BanditResult, float]:
    """The result, and the wall time in seconds."""
    start = time.perf_counter()
    result = train(config, seeds)
    return result, round(time.perf_counter() - start, 1)


def study(config: BanditConfig, seeds: Sequence[int]) -> dict[str, Any]:
    """Successes when pi(z) is rewarded with the whole bound of Eq. 3.2, for both gradients of the reward."""
    variants = {
        f"full_bound_{gradient}": replace(config, full_bound=True, gradient=gradient)
        for gradient in ("score", "pathwise")
    }
    return {name: summary(train_rpg(variant, seeds)) for name, variant in variants.items()}


def summary(result: BanditResult) -> dict[str, Any]:
    """How many seeds succeeded, and the spread of what they ended with."""
    return {
        "successes": int(result.success.sum()),
        "of": len(result.seeds),
        "mean_reward": round(float(result.mean_reward[:, -1].mean()), 4),
        "mass_global_min": round(float(result.mass_global[:, -1].min()), 4),
        "mass_global_median": round(float(np.median(result.mass_global[:, -1])), 4),
        "mass_global_max": round(float(result.mass_global[:, -1].max()), 4),
    }


def final_rows(results: dict[str, BanditResult]) -> list[dict[str, object]]:
    """One row for each method and seed, at the end of training."""
    return [
        {
            "method": method,
            "seed": seed,
            "mean_reward": f"{result.mean_reward[row, -1]:.4f}",
            "mass_global": f"{result.mass_global[row, -1]:.4f}",
            "success": int(result.success[row]),
        }
        for method, result in results.items()
        for row, seed in enumerate(result.seeds)
    ]


def curve_rows(results: dict[str, BanditResult]) -> list[dict[str, object]]:
    """One row for each method, seed and snapshot."""
    return [
        {
            "method": method,
            "seed": seed,
            "step": step,
            "mean_reward": f"{result.mean_reward[row, column]:.4f}",
            "mass_global": f"{result.mass_global[row, column]:.4f}",
        }
        for method, result in results.items()
        for row, seed in enumerate(result.seeds)
        for column, step in enumerate(result.steps)
    ]


def policy_rows(results: dict[str, BanditResult], seed: int) -> list[dict[str, object]]:
    """One row for each method, snapshot and latent of one seed: its density in closed form."""
    rows: list[dict[str, object]] = []
    for method, result in results.items():
        weight, mean, log_std = (field[result.seeds.index(seed)] for field in result.policy)  # (E, latents)
        for column, step in enumerate(result.steps):
            for latent in range(weight.shape[1]):
                row = [f"{float(field[column, latent]):.6g}" for field in (weight, mean, log_std)]
                rows.append(dict(zip(TRAJECTORY, [method, step, latent, *row], strict=True)))
    return rows


def write_csv(path: Path, rows: list[dict[str, object]]) -> None:
    """Write rows with equal keys under a header."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a file this script wrote.

    Raises:
        RPGError: the file is not there.
    """
    if not path.exists():
        raise RPGError(f"{path} is missing; run the script without --redraw first")
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def commit() -> str:
    """Hash of the checkout, ``-dirty`` if tracked files differ from it, or "unknown" outside of git."""
    folder = Path(__file__).resolve().parent

    def git(*command: str) -> str:
        done = subprocess.run(["git", *command], cwd=folder, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    head = git("rev-parse", "HEAD")
    return f"{head}{'-dirty' if git('status', '--porcelain', '-uno') else ''}" if head else "unknown"


def cpu_name() -> str:
    """Model name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def draw(out: Path) -> None:
    """Draw ``figure_3_4.png`` from ``policy.csv`` and ``curves.csv`` in ``out``.

    Raises:
        RPGError: a file is missing.
    """
    policies = load_policies(read_csv(out / "policy.csv"))
    curves = read_csv(out / "curves.csv")
    with plt.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = plt.figure(figsize=(12.5, 4.1), layout="constrained")
        figure.supxlabel(CAPTION, fontsize=8, color="0.35")
        grid = figure.add_gridspec(2, len(PANELS) + 1, width_ratios=[1.0] * len(PANELS) + [1.75])
        for row, method in enumerate(METHODS):
            steps, policy = policies[method]
            for column, fraction in enumerate(PANELS):
                index = int(np.abs(steps - fraction * steps[-1]).argmin())
                axes = figure.add_subplot(grid[row, column])
                moment = TanhNormalMixture(*(field[index] for field in policy))
                draw_density(axes, method, moment)
                if row == 0:
                    axes.set_title(f"{steps[index]:,} updates".replace(",", " "), fontsize=9)
                    axes.tick_params(labelbottom=False)
                else:
                    axes.set_xlabel("action")
                if column == 0:
                    axes.set_ylabel(f"$\\bf{{{TITLES[method]}}}$\nreward")
                else:
                    axes.tick_params(labelleft=False)
        draw_curves(figure.add_subplot(grid[:, -1]), curves)
        save(figure, out / "figure_3_4.png")


def load_policies(rows: Iterable[dict[str, str]]) -> dict[str, tuple[np.ndarray, TanhNormalMixture]]:
    """For each method its snapshots (E,) and its policy at them, fields (E, latents)."""
    policies = {}
    for method in METHODS:
        mine = [row for row in rows if row["method"] == method]
        steps = sorted({int(row["step"]) for row in mine})
        fields = (
            torch.tensor([float(row[name]) for row in mine], dtype=torch.float64).reshape(len(steps), -1)
            for name in ("weight", "mean", "log_std")
        )
        policies[method] = (np.array(steps), TanhNormalMixture(*fields))
    return policies


def draw_density(axes: Axes, method: str, policy: TanhNormalMixture) -> None:
    """The landscape in grey and the action density over it, one colour for each latent."""
    action = torch.linspace(-1, 1, 4001, dtype=torch.float64)[1:-1]
    axes.fill_between(action, bandit_reward(action), color="0.82", linewidth=0)
    axes.set(xlim=(-1, 1), ylim=(0, 1.3), xticks=(-1, -0.6, 0, 0.875), yticks=(0, 0.5, 1))
    axes.set_xticklabels(["\N{MINUS SIGN}1", "\N{MINUS SIGN}.6", "0", ".875"])

    joint = policy.joint_density(action)  # (latents, n)
    # A wide normal before tanh has poles at -1 and 1, which would flatten everything else.
    total = joint.sum(0)
    peak = float(total[action.abs() < 0.95].max())
    height = 1.05 / max(peak, FLAT_DENSITY)
    colours = LATENT_COLOURS if method == "rpg" else (COLOURS[method],)
    axes.stackplot(action, *(height * joint), colors=colours, alpha=0.75, linewidth=0)
    axes.plot(action, height * total, color="0.15", linewidth=0.8)
    low, high = GLOBAL_PEAK - GLOBAL_HALF_WIDTH, GLOBAL_PEAK + GLOBAL_HALF_WIDTH
    size = "poles at \N{PLUS-MINUS SIGN}1" if float(total.max()) > peak else f"peak {peak:.2g}"
    note = f"{size}\non global mode {float(policy.mass(low, high)):.2f}"
    axes.text(0.97, 0.98, note, transform=axes.transAxes, ha="right", va="top", fontsize=7)


def draw_curves(axes: Axes, rows: list[dict[str, str]]) -> None:
    """Expected reward along training, one thin line for each seed."""
    labels = {"rpg": 0.83, "gaussian": 0.19}  # heights that stay clear of the curves at the right end
    for level, name in ((1.1, "global optimum"), (0.5, "local optimum")):
        axes.axhline(level, color="0.6", linewidth=0.8, linestyle=(0, (4, 3)))
        axes.text(0.99, level + 0.012, name, color="0.4", ha="right", transform=axes.get_yaxis_transform())
    for method in METHODS:
        mine = [row for row in rows if row["method"] == method]
        seeds = sorted({int(row["seed"]) for row in mine})
        steps = np.array(sorted({int(row["step"]) for row in mine}))
        reward = np.array([float(row["mean_reward"]) for row in mine]).reshape(len(seeds), len(steps))
        axes.plot(steps, reward.T, color=COLOURS[method], linewidth=0.7, alpha=0.6)
        label = f"{TITLES[method]}, {len(seeds)} seeds"
        place = axes.get_yaxis_transform()
        axes.text(0.99, labels[method], label, color=COLOURS[method], ha="right", transform=place)
    axes.set(xlim=(0, steps[-1]), ylim=(0, 1.2), xlabel="updates", ylabel="expected reward")
    axes.set_xticks(np.linspace(0, steps[-1], 5))


def save(figure: Figure, path: Path) -> None:
    """Write the picture and say where."""
    figure.savefig(path, dpi=200)
    plt.close(figure)
    print(f"wrote {path}")


if __name__ == "__main__":
    sys.exit(main())
