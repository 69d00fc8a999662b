from __future__ import annotations

from math import cos, sin

import pytest
import torch

from rpg.errors import RPGError
from rpg.exploration import ObjectsOfInterest, positional_encoding
from rpg.exploration.positional import encoded_dim
from rpg.world_model import ObservationInput


def test_matches_values_by_hand() -> None:
    encoded = positional_encoding(torch.tensor([0.5, -1.0]), frequencies=2)
    sines = [sin(0.5), sin(1.0), sin(-1.0), sin(-2.0)]
    cosines = [cos(0.5), cos(1.0), cos(-1.0), cos(-2.0)]
    assert encoded.tolist() == pytest.approx([0.5, -1.0, *sines, *cosines])


@pytest.mark.parametrize(("k", "frequencies", "width"), [(1, 0, 1), (3, 1, 9), (2, 6, 26), (0, 6, 0)])
def test_width_is_known_in_advance(k: int, frequencies: int, width: int) -> None:
    assert encoded_dim(k, frequencies) == width
    assert positional_encoding(torch.zeros(4, 5, k), frequencies).shape == (4, 5, width)


def test_no_frequencies_leave_the_scalars_as_they_are() -> None:
    x = torch.randn(3, 2)
    assert torch.equal(positional_encoding(x, 0), x)


def test_rows_are_encoded_independently() -> None:
    x = torch.randn(4, 5, 3)
    torch.testing.assert_close(positional_encoding(x, 3)[2, 1], positional_encoding(x[2, 1], 3))


def test_objects_are_picked_shifted_and_scaled() -> None:
    objects = ObjectsOfInterest.of((2, 0), scale=(10.0, 0.5), offset=(0.1, 4.0))
    obs = torch.tensor([[6.0, 99.0, 0.3]])
    torch.testing.assert_close(objects.select(obs), torch.tensor([[2.0, 1.0]]))
    assert ObjectsOfInterest.everything(3).select(obs).tolist() == obs.tolist()


def test_objects_with_the_wrong_number_of_scales_are_refused() -> None:
    with pytest.raises(RPGError, match="2 indices but 3 scales"):
        ObjectsOfInterest.of((0, 1), scale=(1.0, 2.0, 3.0))


def test_network_input_is_the_scaled_observation_beside_its_encoded_objects() -> None:
    objects = ObjectsOfInterest.of((1,), scale=2.0)
    make = ObservationInput(2, objects, obs_scale=0.01, frequencies=1)
    out = make(torch.tensor([[3.0, 0.25]]))
    assert make.dim == 5
    assert out[0].tolist() == pytest.approx([0.03, 0.0025, 0.5, sin(0.5), cos(0.5)])
