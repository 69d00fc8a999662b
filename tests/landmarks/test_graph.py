from __future__ import annotations

import math

import pytest
import torch

from rpg.landmarks.graph import clip_edges, edge_limits, landmark_edges


@pytest.mark.parametrize("tau", [0.05, 0.3, 2.0])
def test_edges_are_those_of_a_double_loop(tau: float) -> None:
    steps = torch.rand(25, 25, generator=torch.Generator().manual_seed(0))
    edges = landmark_edges(steps, tau)
    for i in range(25):
        for j in range(25):
            into = [float(steps[k, j]) for k in range(25) if k != j]
            kept = i != j and (steps[i, j] <= tau or float(steps[i, j]) == min(into))
            assert float(edges[i, j]) == (float(steps[i, j]) if kept else math.inf)
    assert (edges.isfinite().sum(dim=0) >= 1).all()


def test_edges_into_goals_need_no_diagonal() -> None:
    steps = torch.tensor([[1.0, 9.0], [0.5, 8.0], [3.0, 8.0]])
    expected = torch.tensor([[1.0, math.inf], [0.5, 8.0], [math.inf, 8.0]])
    assert torch.equal(clip_edges(steps, 2.0), expected)


def test_where_no_way_leads_no_edge_is_made() -> None:
    assert not landmark_edges(torch.full((3, 3), math.inf), 2.0).isfinite().any()
    assert not landmark_edges(torch.zeros(1, 1), 2.0).isfinite().any()


def test_limits_are_the_same_before_and_after_clipping() -> None:
    steps = torch.tensor([[1.0, 9.0, math.inf], [0.5, 8.0, math.inf]])
    for edges in (steps, clip_edges(steps, 2.0)):
        assert edge_limits(edges, 2.0).tolist() == [2.0, 8.0, 2.0]
