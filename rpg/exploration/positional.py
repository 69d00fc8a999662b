"""Positional encoding of object scalars (Sec. 3.3.3)."""

from __future__ import annotations

import torch
from torch import Tensor


def encoded_dim(k: int, frequencies: int) -> int:
    """Width of the encoding of ``k`` scalars."""
    return k * (1 + 2 * frequencies)


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """Each scalar beside its sines and cosines at octaves 2^0 .. 2^(frequencies - 1).

    Args:
        x: (..., k).
        frequencies: number of octaves; 6 in Table 3.1, 0 returns ``x`` unchanged.

    Returns:
        (..., k * (1 + 2 * frequencies)): raw scalars first, then sines, then cosines.
    """
    if frequencies == 0:
        return x
    octaves = torch.exp2(torch.arange(frequencies, dtype=x.dtype, device=x.device))
    phase = (x.unsqueeze(-1) * octaves).flatten(-2)
    return torch.cat([x, phase.sin(), phase.cos()], dim=-1)
