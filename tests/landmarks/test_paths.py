from __future__ import annotations

import math
from itertools import pairwise

import networkx as nx
import pytest
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.landmarks import paths


def random_edges(size: int, share: float, seed: int, zeros: bool = False) -> Tensor:
    """Directed, lengths in (0, 1), some of them zero if asked for; ``share`` of all edges exist."""
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(size, size, generator=generator) + 1e-3
    if zeros:
        edges[torch.rand(size, size, generator=generator) < 0.2] = 0.0
    edges[torch.rand(size, size, generator=generator) >= share] = math.inf
    return edges.fill_diagonal_(math.inf)


def graph_of(edges: Tensor) -> nx.DiGraph:
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(edges)))
    graph.add_weighted_edges_from((i, j, float(edges[i, j])) for i, j in edges.isfinite().nonzero().tolist())
    return graph


def by_networkx(edges: Tensor) -> Tensor:
    found = torch.full(edges.shape, math.inf)
    for source, lengths in nx.all_pairs_dijkstra_path_length(graph_of(edges)):
        for target, length in lengths.items():
            found[source, target] = length
    return found


@pytest.mark.parametrize("zeros", [False, True])
@pytest.mark.parametrize(
    ("size", "share"), [(1, 1.0), (2, 0.5), (30, 0.03), (60, 0.06), (40, 0.3), (25, 1.0)]
)
def test_shortest_paths_are_those_of_networkx(size: int, share: float, zeros: bool) -> None:
    for seed in range(3):
        edges = random_edges(size, share, seed, zeros)
        expected = by_networkx(edges)
        torch.testing.assert_close(paths.shortest_paths(edges), expected)
        torch.testing.assert_close(paths.doubled_paths(edges), expected)


def test_both_ways_of_scipy_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    used = []
    for name in ("dijkstra", "floyd_warshall"):
        true = getattr(paths, name)
        monkeypatch.setattr(paths, name, lambda m, name=name, true=true: used.append(name) or true(m))
    for share in (0.05, 0.5):
        edges = random_edges(50, share, 0)
        torch.testing.assert_close(paths.shortest_paths(edges), by_networkx(edges))
    assert used == ["dijkstra", "floyd_warshall"]


def test_several_maps_at_once_and_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    edges = torch.stack([random_edges(30, 0.1, seed) for seed in range(4)])
    together = paths.doubled_paths(edges)
    monkeypatch.setattr(paths, "_ELEMENTS", 1000)  # one row at a time
    assert torch.equal(paths.doubled_paths(edges), together)
    for one, found in zip(edges, together, strict=True):
        torch.testing.assert_close(found, by_networkx(one))


def test_negative_and_unknown_lengths_are_refused() -> None:
    for bad in (-1.0, math.nan):
        with pytest.raises(RPGError, match="at least 0"):
            paths.shortest_paths(torch.full((3, 3), bad))


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_a_map_that_grows_has_the_paths_of_the_whole(share: float) -> None:
    edges = random_edges(40, share, 7)
    grown = paths.extended_paths(paths.shortest_paths(edges[:25, :25]), edges)
    torch.testing.assert_close(grown, paths.shortest_paths(edges))


def test_a_route_is_a_shortest_path() -> None:
    for seed in range(5):
        edges = random_edges(30, 0.08, seed, zeros=True)
        expected = by_networkx(edges)
        for target in range(1, 30):
            nodes = paths.route(edges, 0, target)
            if expected[0, target].isinf():
                assert nodes == []
                continue
            assert (nodes[0], nodes[-1]) == (0, target)
            length = sum(float(edges[i, j]) for i, j in pairwise(nodes))
            assert length == pytest.approx(float(expected[0, target]), abs=1e-5)


def test_lengths_to_goals_that_hang_on_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    edges = random_edges(30, 0.1, 1)
    lasts = torch.rand(30, 6, generator=torch.Generator().manual_seed(2))
    lasts[lasts > 0.3] = math.inf
    lasts[:, 5] = math.inf
    found = paths.shortest_paths(edges)
    expected = torch.stack([(found + lasts[:, g]).amin(dim=1) for g in range(6)], dim=1)
    assert expected[:, 5].isinf().all()
    torch.testing.assert_close(paths.lengths_through(found, lasts), expected)
    monkeypatch.setattr(paths, "_ELEMENTS", 1)
    torch.testing.assert_close(paths.lengths_through(found, lasts), expected)


def soft_doubling_by_loops(edges: Tensor, softness: float, rounds: int) -> Tensor:
    """As the published planner does it, one pair at a time."""
    size = len(edges)
    known = edges.double().clone().fill_diagonal_(0.0)
    for _ in range(rounds):
        longer = torch.full_like(known, math.inf)
        for i in range(size):
            for j in range(size):
                over = known[i] + known[:, j]
                over = over[over.isfinite()]
                if len(over):
                    longer[i, j] = (torch.softmax(-softness * over, dim=0) * over).sum()
        known = longer
    return known.float()


def test_soft_paths_are_averages_over_stops() -> None:
    edges = random_edges(8, 0.4, 3) * 5
    for rounds in (1, 2, 5):
        expected = soft_doubling_by_loops(edges, 0.9, rounds)
        torch.testing.assert_close(paths.soft_paths(edges, 0.9, rounds), expected, rtol=1e-4, atol=1e-4)


def test_soft_paths_come_out_too_long_and_harden() -> None:
    edges = random_edges(20, 0.3, 4) * 5
    exact, soft = paths.shortest_paths(edges), paths.soft_paths(edges, 0.9)
    reached = exact.isfinite()
    assert torch.equal(soft.isfinite(), reached)
    assert (soft[reached] >= exact[reached] - 1e-4).all()
    assert float((soft - exact)[reached].mean()) > 0.1
    torch.testing.assert_close(paths.soft_paths(edges, 1e4), exact, rtol=1e-3, atol=1e-3)
