"""How far backward the half-cheetah comes in an episode without learning: why cheetah_back asks for 20 m.

    python scripts/cheetah_distance.py        # -> results/cheetah_back/distance.csv, two minutes

Every line is one way to act, open loop: noise of several kinds, and a periodic motion of every joint.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from side_by_side import write_table

from rpg.envs.mujoco.cheetah_back import CheetahBackEnv
from rpg.provenance import commit

_OUT = Path("results/cheetah_back/distance.csv")
_COLUMNS = ["acts", "episodes", "median_m", "farthest_m", "beyond", "distance_m", "commit"]
_STEPS, _JOINTS, _STEP_S = 1000, 6, 0.05

Actions = NDArray[np.float64]
Source = Callable[[np.random.Generator], Actions]
"""A generator to the actions of one episode, (steps, joints)."""


def uniform(held: int) -> Source:
    """Uniform actions, each for ``held`` steps."""
    return lambda rng: rng.uniform(-1, 1, (-(-_STEPS // held), _JOINTS)).repeat(held, axis=0)[:_STEPS]


def squashed(deviation: float) -> Source:
    """tanh of normal numbers."""
    return lambda rng: np.tanh(deviation * rng.standard_normal((_STEPS, _JOINTS)))


def correlated(correlation: float) -> Source:
    """tanh of a first-order autoregressive process of deviation 1."""

    def draw(rng: np.random.Generator) -> Actions:
        noise = rng.standard_normal((_STEPS, _JOINTS))
        for i in range(1, _STEPS):
            noise[i] = correlation * noise[i - 1] + np.sqrt(1 - correlation**2) * noise[i]
        return np.tanh(noise)

    return draw


def periodic(square: bool) -> Source:
    """A sine for every joint with a random phase and one random frequency, 0.5 to 5 Hz; or its sign."""

    def draw(rng: np.random.Generator) -> Actions:
        time = _STEP_S * np.arange(_STEPS)[:, None]
        wave = np.sin(2 * np.pi * (rng.uniform(0.5, 5) * time + rng.uniform(size=_JOINTS)))
        return np.sign(wave) if square else wave

    return draw


SOURCES: dict[str, tuple[Source, int]] = {
    "uniform noise": (uniform(1), 400),
    "tanh of normal noise, deviation 0.4": (squashed(0.4), 200),
    "tanh of normal noise, deviation 1": (squashed(1.0), 200),
    "uniform noise, held for 2 steps": (uniform(2), 100),
    "uniform noise, held for 3 steps": (uniform(3), 100),
    "uniform noise, held for 5 steps": (uniform(5), 100),
    "uniform noise, held for 10 steps": (uniform(10), 100),
    "tanh of normal noise, correlation 0.9": (correlated(0.9), 100),
    "a sine for each joint, 0.5 to 5 Hz": (periodic(False), 200),
    "a square wave for each joint, 0.5 to 5 Hz": (periodic(True), 200),
}
"""What acts, and for how many episodes."""


def farthest_backward(env: CheetahBackEnv, actions: Actions, seed: int) -> float:
    """Metres behind the start, at the episode's farthest."""
    env.reset(seed=seed)
    start = float(env.data.qpos[0])
    return max(start - env.step(action)[4]["x_position"] for action in actions)


def main() -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Distances of behaviour that has not learned.")
    parser.add_argument("--out", type=Path, default=_OUT)
    args = parser.parse_args()
    rows: list[dict[str, object]] = []
    with closing(CheetahBackEnv()) as env:
        for name, (source, episodes) in SOURCES.items():
            rng = np.random.default_rng(0)
            reached = np.array([farthest_backward(env, source(rng), seed) for seed in range(episodes)])
            rows.append(
                {
                    "acts": name, "episodes": episodes, "median_m": round(float(np.median(reached)), 1),
                    "farthest_m": round(float(reached.max()), 1), "beyond": int((reached > env.distance).sum()),
                    "distance_m": env.distance, "commit": commit(),
                }
            )  # fmt: skip
            print(rows[-1])
    write_table(args.out, _COLUMNS, rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
