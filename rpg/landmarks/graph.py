"""Which nodes of the map are connected (thesis Sec. 4.5.3, Algorithm 2 lines 3 to 9)."""

from __future__ import annotations

from torch import Tensor, inf


def clip_edges(steps: Tensor, tau: float) -> Tensor:
    """Leave out edges that are too long to be trusted, but none that is the only way in.

    Args:
        steps: (n, m) lengths of the edges from rows to columns; infinite where there is none.
        tau: longest edge to keep. The shortest edge into each column is kept all the same (all of them,
            if several are equally short), so that nothing is cut off by a ``tau`` that is a little too small.

    Returns:
        (n, m), infinite where there is no edge.
    """
    return steps.masked_fill(steps > edge_limits(steps, tau), inf)


def edge_limits(edges: Tensor, tau: float) -> Tensor:
    """The longest edge that may lead into each column, (m,), of edges (n, m), clipped or not."""
    shortest = edges.amin(dim=0)
    return shortest.masked_fill(shortest.isinf(), 0.0).clamp_min(tau)


def landmark_edges(steps: Tensor, tau: float) -> Tensor:
    """The map's edges, (N, N), of the distances (N, N) between landmarks: clipped, and none to oneself."""
    others = steps.clone()
    others.fill_diagonal_(inf)
    return clip_edges(others, tau)
