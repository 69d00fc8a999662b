"""Random numbers for a batch of environments: a stream for each, all drawn from by one call."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX = (
    (np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)),
    (np.uint64(27), np.uint64(0x94D049BB133111EB)),
)


class Streams:
    """One generator (SplitMix64; Steele, Lea and Flood 2014) for each environment.

    What a stream yields depends on its seed alone, not on the size of the batch or on the other streams, and a
    thousand of them cost little more than one.

    Args:
        count: of streams. Unless they are seeded, no two runs draw the same.
    """

    def __init__(self, count: int) -> None:
        self._state = np.frombuffer(os.urandom(8 * count), dtype=np.uint64).copy()

    def seed(self, mask: Mask, seed: int | Sequence[int | None] | None) -> None:
        """Begin streams where ``mask`` (count,) is True: number i at ``seed + i``, or each at its own.

        Streams whose seed is None go on.
        """
        if seed is None:
            return
        if isinstance(seed, int):
            seed = range(seed, seed + len(mask))
        known = mask & np.array([own is not None for own in seed])
        seeds = np.array([0 if own is None else int(own) % 2**64 for own in seed], dtype=np.uint64)
        self._state[known] = _mixed(seeds[known])  # neighbouring seeds begin far apart

    def uniform(self, rows: Integers, size: int) -> Floats:
        """Numbers in [0, 1), (len(rows), size), of the streams ``rows``, none of them named twice."""
        ahead = np.arange(1, size + 1, dtype=np.uint64) * _STEP
        bits = _mixed(self._state[rows, None] + ahead)
        self._state[rows] += ahead[-1]
        return (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53

    def where(self, rows: Integers, low: Floats, high: Floats, accept: Callable[[Floats], Mask]) -> Floats:
        """Places (len(rows), d), each uniform among those between ``low`` and ``high`` (d,) that are accepted.

        Args:
            rows: streams, none of them named twice.
            low: corner of the box to draw from.
            high: the opposite corner.
            accept: (n, d) -> (n,) bool; must be True somewhere.
        """
        places = np.empty((len(rows), len(low)))
        waiting = np.arange(len(rows))
        while waiting.size:
            drawn = low + self.uniform(rows[waiting], len(low)) * (high - low)
            fits = accept(drawn)
            places[waiting[fits]] = drawn[fits]
            waiting = waiting[~fits]
        return places

    def get_state(self) -> Integers:
        """(count,), copied; with the bits of the unsigned state, for torch has few operations on those."""
        return self._state.view(np.int64).copy()

    def set_state(self, state: Integers) -> None:
        """Continue from what :meth:`get_state` returned."""
        self._state = np.array(state, dtype=np.int64).view(np.uint64)


def _mixed(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    for shift, factor in _MIX:
        bits = (bits ^ (bits >> shift)) * factor
    return bits ^ (bits >> np.uint64(31))
