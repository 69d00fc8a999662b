"""Farthest-point sampling: few points that cover many (thesis Sec. 4.5.3, Algorithm 2 line 2).

On the CPU in numpy whatever the agent's device: each choice waits for the last one, so a GPU would spend its
time on launching kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]


def farthest_points(points: ArrayLike, count: int, gap: float = 0.0) -> Indices:
    """Choose points that are far from each other in L2.

    The first is the first of ``points``, every further one the one that is farthest from those chosen.

    Args:
        points: (n, G).
        count: most points to choose.
        gap: stop when all points are within this distance of a chosen one, so that none comes twice.

    Returns:
        (k,) indices in the order of choice, k <= count.
    """
    columns = np.ascontiguousarray(np.asarray(points, dtype=np.float32).T)  # (G, n): a choice reads rows
    offset = np.empty_like(columns)
    squared = np.empty(columns.shape[1], dtype=np.float32)
    nearest = np.full_like(squared, np.inf)
    limit, chosen = np.float32(gap) ** 2, 0
    order = np.empty(min(count, len(nearest)), dtype=np.int64)
    for place in range(len(order)):
        order[place] = chosen
        np.subtract(columns, columns[:, chosen : chosen + 1], out=offset)
        np.multiply(offset, offset, out=offset)
        np.add.reduce(offset, axis=0, out=squared)
        np.minimum(nearest, squared, out=nearest)
        chosen = int(nearest.argmax())
        if nearest[chosen] <= limit:
            return order[: place + 1]
    return order


def farthest_points_by(row: Callable[[int], Floats], count: int, gap: float = 0.0) -> tuple[Indices, Floats]:
    """Choose points that are far from each other by any distance, which may depend on the direction.

    Args:
        row: distances (n,) from the point of an index to all points; called once for each choice.
        count: most points to choose, at least 1.
        gap: as in :func:`farthest_points`.

    Returns:
        (k,) indices in the order of choice, and (k, n) the rows.
    """
    order: list[int] = []
    rows: list[Floats] = []
    nearest: Floats = np.empty(0)
    chosen = 0
    while len(order) < count:
        order.append(chosen)
        rows.append(row(chosen))
        # A learned distance to oneself need not be zero, and nothing shall be chosen twice.
        reach = rows[-1].copy()
        reach[chosen] = 0.0
        nearest = np.minimum(nearest, reach) if nearest.size else reach
        chosen = int(nearest.argmax())
        if nearest[chosen] <= gap:
            break
    return np.array(order, dtype=np.int64), np.stack(rows)


def members_after(between: Floats, held: int, capacity: int, gap: float = 0.0) -> Indices:
    """Let new points into a cover that stands: farthest first while there is room, then by changing places.

    A full cover gives the place of its most crowded member, the one nearest to another, to a newcomer that
    is farther from all members than that. So the smallest distance between two members never falls, where it
    is the same in both directions.

    Args:
        between: (n, n) distances from row to column; the first ``held`` are members, the others come new.
        held: members there are, at least 1.
        capacity: most members; not below ``held``.
        gap: a newcomer within this distance of a member stays out.

    Returns:
        (k,) which of the n points is in each place, ``held`` <= k <= ``capacity``. Members that stay keep theirs.
    """
    apart = np.array(between, dtype=np.float32)
    np.fill_diagonal(apart, np.inf)
    members = list(range(held))
    offered = np.arange(len(apart)) >= held
    cover = apart[:held].min(axis=0)  # distance of every point from its nearest member; of a member, another
    while offered.any():
        best = int(np.where(offered, cover, -np.inf).argmax())
        offered[best] = False
        if cover[best] <= gap:
            break
        if len(members) < capacity:
            members.append(best)
            np.minimum(cover, apart[best], out=cover)
            continue
        place = int(cover[members].argmin())
        if cover[best] <= cover[members[place]]:
            break
        members[place] = best
        cover = apart[members].min(axis=0)
    return np.array(members, dtype=np.int64)
