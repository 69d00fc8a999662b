"""Aggregates for few-seed experiments: interquartile mean, stratified bootstrap, probability of improvement, front.

The definitions are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice" (NeurIPS 2021), as computed by their package ``rliable`` 1.2.0; ``tests/test_stats.py`` holds
values recorded from it. Two deliberate differences: every draw here comes from the given ``seed`` (rliable
1.2.0 ignores its ``random_state``), and a curve is resampled as a whole, not step by step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rpg.errors import RPGError

FloatArray: TypeAlias = NDArray[np.float64]
Statistic: TypeAlias = Callable[..., Any]

_BLOCK_FLOATS = 8_000_000  # 64 MB of resampled scores at a time, however long the curve is


def iqm(x: ArrayLike, axis: int | tuple[int, ...] | None = None) -> FloatArray:
    """Interquartile mean: the mean of what is left after dropping the lowest and the highest quarter.

    Args:
        x: scores of any shape, finite.
        axis: axis or axes to reduce, flattened together; all of them by default.

    Returns:
        An array of the shape of ``x`` without ``axis``; a scalar array if nothing is left.

    Equal to ``scipy.stats.trim_mean(x, 0.25)``: ``int(n / 4)`` values go at each end, so of fewer than
    four values none does. Raises :class:`RPGError` on an empty or non-finite input, which sorting would
    otherwise hide in the part that is cut off.
    """
    values = _finite(x, "iqm")
    axes = tuple(range(values.ndim)) if axis is None else (axis,) if isinstance(axis, int) else axis
    values = np.moveaxis(values, axes, range(-len(axes), 0))
    values = values.reshape(*values.shape[: values.ndim - len(axes)], -1)  # (..., n)
    count = values.shape[-1]
    cut = int(0.25 * count)
    kept = np.partition(values, (cut, count - cut - 1), axis=-1)[..., cut : count - cut]
    return np.asarray(kept.mean(axis=-1))


def stratified_bootstrap(
    scores: ArrayLike,
    statistic: Statistic = iqm,
    reps: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Percentile interval of ``statistic`` when the seeds of every task are drawn anew, with replacement.

    Args:
        scores: ``(seeds, tasks)``, or ``(seeds, tasks, steps)`` for curves. Tasks are the strata: each is
            resampled by itself. A resampled seed brings its whole curve along, so that bands are smooth;
            the interval at any one step has the same distribution as if that step had been drawn alone.
        statistic: a reduction called as ``statistic(array, axis=(-2, -1))`` on ``(..., seeds, tasks)``:
            :func:`iqm`, ``numpy.mean``, ``numpy.median``, or your own.
        reps: number of resamplings.
        confidence: probability that the interval covers, in (0, 1).
        seed: seed of the draws; equal arguments give equal intervals.

    Returns:
        ``(point, low, high)``, each of shape ``()`` or ``(steps,)``. With one seed the three are equal,
        which says that nothing is known about the spread, not that there is none.

    Raises:
        RPGError: ``scores`` has another shape, is empty or is not finite; ``reps`` or ``confidence`` is out
            of range.
    """
    values = _finite(scores, "stratified_bootstrap")
    if values.ndim not in (2, 3):
        raise RPGError(f"stratified_bootstrap: scores of shape {values.shape}, need (seeds, tasks[, steps])")
    if reps < 1 or not 0.0 < confidence < 1.0:
        raise RPGError(
            f"stratified_bootstrap: reps {reps}, confidence {confidence}; need reps >= 1, 0 < confidence < 1"
        )
    curves = values if values.ndim == 3 else values[:, :, None]
    curves = np.ascontiguousarray(np.moveaxis(curves, 2, 0))  # (steps, seeds, tasks)
    steps, seeds, tasks = curves.shape
    draws = np.random.default_rng(seed).integers(seeds, size=(reps, seeds, tasks))

    tail = (1.0 - confidence) / 2.0
    limits = np.empty((2, steps))
    block = max(1, _BLOCK_FLOATS // draws.size)
    for start in range(0, steps, block):
        sample = curves[start : start + block, draws, np.arange(tasks)]  # (block, reps, seeds, tasks)
        estimates = statistic(sample, axis=(-2, -1))
        limits[:, start : start + block] = np.quantile(estimates, (tail, 1.0 - tail), axis=-1)

    point = np.asarray(statistic(curves, axis=(-2, -1)), dtype=np.float64)
    shape = values.shape[2:]
    return point.reshape(shape), limits[0].reshape(shape), limits[1].reshape(shape)


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Probability that a random run of X beats a random run of Y on the same task, averaged over tasks.

    Args:
        x: ``(seeds_x, tasks)`` scores of X.
        y: ``(seeds_y, tasks)`` scores of Y; the seeds need not be as many.

    Returns:
        The mean over tasks of the Mann-Whitney U statistic divided by ``seeds_x * seeds_y``; a tie counts
        one half.

    Raises:
        RPGError: the shapes do not fit, or a score is not finite.
    """
    left, right = _finite(x, "probability_of_improvement"), _finite(y, "probability_of_improvement")
    if left.ndim != 2 or right.ndim != 2 or left.shape[1] != right.shape[1]:
        raise RPGError(
            f"probability_of_improvement: shapes {left.shape} and {right.shape}, need (seeds, tasks) with the"
            " same tasks"
        )
    difference = left[:, None] - right[None, :]  # (seeds_x, seeds_y, tasks)
    return float((difference > 0).mean() + 0.5 * (difference == 0).mean())


def pareto_front(cost: ArrayLike, value: ArrayLike) -> NDArray[np.intp]:
    """The points that no other beats: none is as cheap and as good, and cheaper or better.

    Args:
        cost: ``(n,)``, lower is better.
        value: ``(n,)``, higher is better.

    Returns:
        ``(k,)`` indices, the cheapest first; value rises with cost. Equal points are on the front together.

    Raises:
        RPGError: the shapes do not fit, or a number is not finite.
    """
    costs, values = _finite(cost, "pareto_front: cost"), _finite(value, "pareto_front: value")
    if costs.ndim != 1 or costs.shape != values.shape:
        raise RPGError(f"pareto_front: shapes {costs.shape} and {values.shape}, need (n,) twice")
    cheaper, better = costs[:, None] - costs, values - values[:, None]  # [i, j]: by how much j beats i
    beaten = ((cheaper >= 0) & (better >= 0) & ((cheaper > 0) | (better > 0))).any(axis=1)
    front = np.flatnonzero(~beaten)
    return front[np.argsort(costs[front], kind="stable")]


def _finite(x: ArrayLike, caller: str) -> FloatArray:
    values = np.asarray(x, dtype=np.float64)
    if values.size == 0:
        raise RPGError(f"{caller}: no scores, the array has shape {values.shape}")
    if not np.isfinite(values).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise RPGError(f"{caller}: score {index} is {values[index]}; leave that run out or say how it counts")
    return values
