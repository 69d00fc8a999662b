from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rpg.errors import RPGError
from rpg.stats import iqm, probability_of_improvement, stratified_bootstrap


def table(seeds: int, tasks: int, shift: int = 0) -> np.ndarray:
    """Scores in [0, 1) from a formula, so that recorded values outlive numpy's generators."""
    i, j = np.mgrid[:seeds, :tasks]
    return np.asarray(((7 * i * i + 13 * j * j + 29 * i * j + 5 * j + shift) % 97) / 97.0)


# Recorded once from rliable 1.2.0 (arch 7.2.0, pandas 2.3.3, numpy 2.4.6) on table(seeds, tasks, shift):
# metrics.aggregate_iqm; metrics.probability_of_improvement against table(seeds + 1, tasks, shift + 40);
# library.get_interval_estimates(reps=50000), mean of the three runs after np.random.seed(0), (1), (2).
RLIABLE = [
    ((5, 4, 0), 0.2917525773195876, 0.29166666666666663, (0.173196, 0.449828)),
    ((10, 3, 11), 0.5605670103092784, 0.5924242424242424, (0.420318, 0.701246)),
    ((6, 1, 3), 0.3221649484536082, 0.47619047619047616, (0.087629, 0.667526)),
]


@pytest.mark.parametrize(("shape", "point", "improvement", "interval"), RLIABLE)
def test_matches_values_recorded_from_rliable(
    shape: tuple[int, int, int], point: float, improvement: float, interval: tuple[float, float]
) -> None:
    seeds, tasks, shift = shape
    x = table(seeds, tasks, shift)
    assert float(iqm(x)) == pytest.approx(point, abs=1e-12)
    assert probability_of_improvement(x, table(seeds + 1, tasks, shift + 40)) == pytest.approx(
        improvement, abs=1e-12
    )
    estimate, low, high = stratified_bootstrap(x, iqm, reps=50_000, seed=0)
    assert float(estimate) == pytest.approx(point, abs=1e-12)
    # rliable itself differs by 0.002 between its three seeds.
    assert (float(low), float(high)) == pytest.approx(interval, abs=0.004)


def test_curves_match_values_recorded_from_rliable() -> None:
    i, j, t = np.mgrid[:5, :3, :4]
    curves = ((7 * i * i + 13 * j * j + 29 * i * j + 5 * j + 17 * t * (i + 1)) % 97) / 97.0
    point, low, high = stratified_bootstrap(curves, iqm, reps=20_000)
    assert point == pytest.approx([0.2691867125, 0.5189003436, 0.3711340206, 0.5864833906], abs=1e-9)
    # 20000 repetitions, np.random.seed(0), runs drawn separately at every step.
    assert low == pytest.approx([0.13631, 0.34593, 0.20733, 0.38832], abs=0.006)
    assert high == pytest.approx([0.44674, 0.66323, 0.59565, 0.73654], abs=0.006)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 8, 50, 101])
def test_iqm_is_scipys_trimmed_mean(count: int) -> None:
    trim_mean = pytest.importorskip("scipy.stats").trim_mean
    x = np.random.default_rng(count).normal(size=(count, 3))
    assert float(iqm(x)) == pytest.approx(trim_mean(x, 0.25, axis=None))
    np.testing.assert_allclose(iqm(x, axis=0), trim_mean(x, 0.25, axis=0))
    np.testing.assert_allclose(iqm(x, axis=-1), trim_mean(x, 0.25, axis=1))


def test_iqm_over_two_axes_flattens_them() -> None:
    x = np.random.default_rng(0).normal(size=(6, 4, 5))
    np.testing.assert_allclose(iqm(x, axis=(-2, -1)), [iqm(sheet) for sheet in x])
    np.testing.assert_allclose(iqm(x, axis=(0, 2)), [iqm(x[:, k]) for k in range(4)])


def test_iqm_ignores_one_outlier_in_four() -> None:
    assert float(iqm([1.0, 2.0, 3.0, 1e9])) == 2.5


def test_bootstrap_is_the_loop_written_out() -> None:
    scores = np.random.default_rng(3).gamma(2.0, size=(5, 3))
    reps, seed = 400, 9
    draws = np.random.default_rng(seed).integers(5, size=(reps, 5, 3))
    estimates = []
    for rep in range(reps):
        sample = [[scores[draws[rep, run, task], task] for task in range(3)] for run in range(5)]
        estimates.append(float(iqm(sample)))
    point, low, high = stratified_bootstrap(scores, iqm, reps=reps, confidence=0.9, seed=seed)
    assert float(point) == float(iqm(scores))
    assert float(low) == pytest.approx(np.quantile(estimates, 0.05))
    assert float(high) == pytest.approx(np.quantile(estimates, 0.95))


def test_bootstrap_agrees_with_an_independent_brute_force_one() -> None:
    scores = np.random.default_rng(4).normal(size=(8, 2))
    draw = np.random.default_rng(123)
    estimates = [np.mean([draw.choice(scores[:, task], size=8) for task in range(2)]) for _ in range(5_000)]
    _, low, high = stratified_bootstrap(scores, np.mean, reps=5_000)
    assert (float(low), float(high)) == pytest.approx(np.quantile(estimates, (0.025, 0.975)), abs=0.04)


def test_bootstrap_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for trial in range(300):
        _, low, high = stratified_bootstrap(rng.normal(size=(30, 1)), np.mean, reps=500, seed=trial)
        hits += bool(low <= 0.0 <= high)
    assert 0.90 <= hits / 300 <= 0.98


def test_bootstrap_of_curves_equals_that_of_each_step_and_blocks_do_not_matter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    curves = np.random.default_rng(5).normal(size=(5, 2, 17)).cumsum(axis=-1)
    whole = stratified_bootstrap(curves, reps=300)
    monkeypatch.setattr("rpg.stats._BLOCK_FLOATS", 300 * 5 * 2 * 4)
    for ours, blocked in zip(whole, stratified_bootstrap(curves, reps=300), strict=True):
        assert ours.shape == (17,)
        np.testing.assert_array_equal(ours, blocked)
    for step in (0, 8, 16):
        for ours, single in zip(whole, stratified_bootstrap(curves[:, :, step], reps=300), strict=True):
            assert single.shape == ()
            assert float(ours[step]) == pytest.approx(float(single))


def test_bootstrap_repeats_with_its_seed_and_leaves_global_numpy_alone() -> None:
    scores = table(5, 4)
    np.random.seed(1)
    untouched = np.random.random(3).tolist()
    np.random.seed(1)
    first, again = stratified_bootstrap(scores, seed=7), stratified_bootstrap(scores, seed=7)
    other = stratified_bootstrap(table(10, 3), seed=8)
    assert [float(v) for v in first] == [float(v) for v in again]
    assert float(other[1]) != float(stratified_bootstrap(table(10, 3), seed=7)[1])
    assert np.random.random(3).tolist() == untouched


def test_one_seed_has_no_spread() -> None:
    point, low, high = stratified_bootstrap([[0.25, 0.75]])
    assert float(point) == float(low) == float(high) == 0.5


def test_probability_of_improvement_counts_wins_and_half_ties() -> None:
    x, y = np.array([[1.0], [2.0]]), np.array([[1.0], [0.0], [3.0]])
    assert probability_of_improvement(x, y) == pytest.approx((0.5 + 1 + 0 + 1 + 1 + 0) / 6)
    assert probability_of_improvement(x, y) + probability_of_improvement(y, x) == pytest.approx(1.0)
    assert probability_of_improvement(x, x) == 0.5


def test_bad_input_is_refused_in_one_line() -> None:
    calls: list[tuple[Callable[[], object], str]]
    bad = table(3, 2)
    bad[1, 0] = np.nan
    calls = [
        (lambda: iqm([]), "no scores"),
        (lambda: iqm(bad), r"score \(1, 0\) is nan"),
        (lambda: stratified_bootstrap(bad), r"score \(1, 0\) is nan"),
        (lambda: stratified_bootstrap([1.0, 2.0]), r"shape \(2,\)"),
        (lambda: stratified_bootstrap([[1.0]], reps=0), "reps 0"),
        (lambda: stratified_bootstrap([[1.0]], confidence=95), "confidence 95"),
        (lambda: probability_of_improvement(table(3, 2), table(3, 4)), "same tasks"),
        (lambda: probability_of_improvement(table(3, 2), bad), "is nan"),
    ]
    for call, message in calls:
        with pytest.raises(RPGError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
