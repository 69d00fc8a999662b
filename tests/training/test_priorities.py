from __future__ import annotations

import pytest
import torch

from rpg.training.priorities import NoveltyPriorities

ROWS, ENVS = 10, 3


def filled(rows: int = ROWS) -> NoveltyPriorities:
    priorities = NoveltyPriorities(ROWS, ENVS, "cpu")
    for row in range(rows):
        priorities.add(row)
    return priorities


def frequencies(priorities: NoveltyPriorities, draws: int = 60_000) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.bincount(priorities.draw(draws), minlength=ROWS * ENVS) / draws


def test_transitions_are_drawn_in_proportion_to_their_bonus() -> None:
    priorities = filled()
    bonus = torch.rand(ROWS * ENVS, generator=torch.Generator().manual_seed(1))
    priorities.judge(torch.arange(ROWS * ENVS), bonus)
    assert frequencies(priorities).numpy() == pytest.approx((bonus / bonus.sum()).numpy(), abs=0.005)


def test_what_is_known_is_hardly_drawn_but_can_be() -> None:
    priorities = filled()
    priorities.judge(torch.arange(ROWS * ENVS), torch.tensor([-1.0] * (ROWS * ENVS)))
    assert frequencies(priorities).min() > 0  # everything is known: uniform
    priorities.judge(torch.tensor([4]), torch.tensor([2.0]))
    assert frequencies(priorities)[4] > 0.99


def test_only_rows_that_hold_something_are_drawn() -> None:
    priorities = filled(4)
    priorities.forget(2)
    drawn = frequencies(priorities).reshape(ROWS, ENVS).sum(1) > 0
    assert drawn.tolist() == [True, True, False, True] + [False] * 6


def test_a_new_transition_weighs_as_much_as_the_most_novel_one_so_far() -> None:
    priorities = filled(2)
    priorities.judge(torch.arange(2 * ENVS), torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 5.0]))
    priorities.add(2)
    assert frequencies(priorities)[5:9].numpy() == pytest.approx([0.25] * 4, abs=0.01)


def test_continues_from_its_state() -> None:
    priorities = filled()
    priorities.judge(torch.arange(ROWS * ENVS), torch.arange(ROWS * ENVS) / 10)
    newest_first = torch.arange(ROWS).flip(0)
    other = filled()
    other.load_state_dict(priorities.state_dict(newest_first))
    assert torch.equal(other._weights, priorities._weights.flip(0))
    other.add(0)
    assert float(other._weights[0, 0]) == pytest.approx(2.9)
