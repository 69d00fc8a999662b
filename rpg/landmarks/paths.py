"""Lengths of all shortest paths of the map (thesis Sec. 4.5.4, Algorithm 2 line 10).

An edge matrix is (N, N), ``edges[i, j]`` the length >= 0 of the edge from i to j, infinite where there is none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra, floyd_warshall
from torch import Tensor, inf

from rpg.errors import RPGError

DENSE = 0.1  # share of all edges from which Floyd and Warshall's algorithm beats Dijkstra's, measured
SOFT_ROUNDS = 20  # of the published planner
_ELEMENTS = 2**22  # of a temporary tensor


def shortest_paths(edges: Tensor) -> Tensor:
    """Length of the shortest path between all pairs, (N, N), zero on the diagonal, infinite without a path.

    On the CPU scipy's Dijkstra, or Floyd and Warshall where edges are many; elsewhere by :func:`doubled_paths`.
    """
    if edges.device.type != "cpu":
        return doubled_paths(edges)
    lengths = _without_loops(edges).numpy()
    solve = dijkstra if np.isfinite(lengths).mean() < DENSE else floyd_warshall
    found = solve(
        _sparse(lengths)
    )  # in a dense matrix a length of zero would mean to scipy that there is no edge
    return torch.from_numpy(found).to(edges.dtype)


def doubled_paths(edges: Tensor) -> Tensor:
    """The same by min-plus products: paths of at most 1, 2, 4, ... edges until nothing changes.

    Args:
        edges: (..., N, N), several maps at once if need be.
    """
    size = edges.shape[-1]
    none = torch.eye(size, dtype=torch.bool, device=edges.device)
    paths, reach = edges.masked_fill(none, 0.0), 1
    while reach < size:
        longer = min_plus(paths, paths)
        if torch.equal(longer, paths):
            break
        paths, reach = longer, 2 * reach
    return paths


def min_plus(left: Tensor, right: Tensor) -> Tensor:
    """min over k of left[..., i, k] + right[..., k, j]: (..., n, k) and (..., k, m) to (..., n, m)."""
    rows = max(1, _ELEMENTS // max(1, right.numel()))
    parts = [
        (part.unsqueeze(-1) + right.unsqueeze(-3)).amin(dim=-2)  # (..., rows, k, m) -> (..., rows, m)
        for part in left.split(rows, dim=-2)
    ]
    return torch.cat(parts, dim=-2)


def soft_paths(edges: Tensor, softness: float, rounds: int = SOFT_ROUNDS) -> Tensor:
    """What the published planner computed: path doubling with averages in place of the minimum.

    Every round replaces the length between i and j by the mean over all stops k of the length over k, with
    weights exp(-softness * length). Means exceed minima, so paths come out too long. Takes O(N^3) a round.

    Args:
        edges: (N, N).
        softness: per step.
        rounds: at most; it ends early when lengths change no more.
    """
    none = torch.eye(len(edges), dtype=torch.bool, device=edges.device)
    paths = edges.masked_fill(none, 0.0)
    rows = max(1, _ELEMENTS // max(1, edges.numel()))
    for _ in range(rounds):
        backwards = paths.T.contiguous()
        parts = [
            soft_min(part.unsqueeze(1) + backwards, softness)  # (rows, N, N): over stops k, the last axis
            for part in paths.split(rows)
        ]
        longer = torch.cat(parts)
        if torch.allclose(longer, paths, rtol=1e-5, atol=1e-5):
            return longer
        paths = longer
    return paths


def soft_min(lengths: Tensor, softness: float) -> Tensor:
    """Mean over the last axis with weights exp(-softness * length); infinite where all lengths are."""
    least = lengths.amin(dim=-1, keepdim=True)
    excess = lengths - least.masked_fill(least.isinf(), 0.0)
    weights = torch.exp(-softness * excess)
    total = (weights * excess.masked_fill(excess.isinf(), 0.0)).sum(dim=-1)
    return least.squeeze(-1) + total / weights.sum(dim=-1).clamp_min(torch.finfo(weights.dtype).tiny)


def lengths_through(paths: Tensor, edges: Tensor, softness: float | None = None) -> Tensor:
    """Lengths of the shortest ways over the map to goals that hang on it by edges of their own.

    Args:
        paths: (N, N), lengths of all paths of the map.
        edges: (N, m), from landmarks to goals; infinite where there is none.
        softness: average as :func:`soft_min` does instead; None takes the minimum.

    Returns:
        (N, m).
    """
    stops = max(1, int(edges.isfinite().sum(dim=0).amax()))  # most edges into a goal
    lasts, places = edges.T.topk(stops, dim=1, largest=False)  # (m, stops), infinite where a goal has fewer
    columns = max(1, _ELEMENTS // (len(edges) * stops))
    found = []
    for last, place in zip(lasts.split(columns), places.split(columns), strict=True):
        over = paths[:, place] + last  # (N, columns, stops)
        found.append(over.amin(dim=-1) if softness is None else soft_min(over, softness))
    return torch.cat(found, dim=1)


def extended_paths(paths: Tensor, edges: Tensor) -> Tensor:
    """All shortest paths of a map that has grown, from those of its first landmarks: O(N^2) for each new one.

    Args:
        paths: (n, n) of the first n landmarks.
        edges: (N, N) of all; among the first n as they were.

    Returns:
        (N, N), as :func:`shortest_paths` finds them.
    """
    held, size = len(paths), len(edges)
    grown = edges.new_full((size, size), inf)
    grown[:held, :held] = paths
    for new in range(held, size):
        known = grown[:new, :new]
        away = _least_over(edges[new, :new], known)  # (new,), from the newcomer
        towards = _least_over(edges[:new, new], known.T)
        grown[new, :new], grown[:new, new], grown[new, new] = away, towards, 0.0
        torch.minimum(known, towards.unsqueeze(1) + away, out=known)
    return grown


def route(edges: Tensor, source: int, target: int) -> list[int]:
    """The nodes of a shortest path, both ends included; empty if there is none."""
    _, before = dijkstra(
        _sparse(_without_loops(edges.cpu()).numpy()), indices=source, return_predecessors=True
    )
    nodes = [target]
    while nodes[-1] != source:
        if (previous := int(before[nodes[-1]])) < 0:
            return []
        nodes.append(previous)
    return nodes[::-1]


def _least_over(first: Tensor, rest: Tensor) -> Tensor:
    """min over k of first[k] + rest[k, j], reading only rows that can be reached."""
    stops = first.isfinite().nonzero().squeeze(1)
    if not len(stops):
        return first.new_full((rest.shape[1],), inf)
    return (first[stops].unsqueeze(1) + rest[stops]).amin(dim=0)


def _without_loops(edges: Tensor) -> Tensor:
    if not bool((edges >= 0).all()):  # NaN too
        raise RPGError("shortest paths: edges must have lengths of at least 0; look at the distance function")
    lengths = edges.to(torch.float64, copy=True)
    lengths.fill_diagonal_(inf)
    return lengths


def _sparse(lengths: NDArray[Any]) -> csr_array:
    """Finite entries as stored ones, zeros among them."""
    rows, columns = np.isfinite(lengths).nonzero()
    return csr_array((lengths[rows, columns], (rows, columns)), shape=lengths.shape)
