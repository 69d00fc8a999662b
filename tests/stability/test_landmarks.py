"""Where maps of landmarks fail (thesis Sec. 4.6.3): the planner stays finite, falls back, and says so."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from worlds import SPEC, planner_of, states_at, straight

from rpg.errors import NonFiniteError, RPGError
from rpg.landmarks import LandmarkPlanner, PlannerConfig

GRID = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0))


def walk(planner: LandmarkPlanner, place: Tensor, goal: Tensor, steps: int) -> Tensor:
    """Where one ends that goes a unit straight towards each subgoal, (2,)."""
    for _ in range(steps):
        (subgoal,) = planner.subgoal(states_at(place.unsqueeze(0)), goal.unsqueeze(0), straight)
        way = subgoal - place
        place = place + way / way.norm().clamp_min(1.0)
    return place


@pytest.mark.parametrize("tau", [1e-6, 0.5])
def test_tau_too_small_leaves_islands(tau: float) -> None:
    """Each landmark keeps its shortest way in; that connects neighbours, not the map."""
    rooms = torch.cat([GRID / 8 + offset for offset in (0.0, 20.0, 40.0)])
    planner = planner_of(rooms, tau=tau)
    assert planner.metrics()["planner/unconnected"] >= 0.5
    assert (planner.map.edges.isfinite().sum(dim=0) >= 1).all()
    here, there = torch.tensor([[0.6, 0.3]]), torch.tensor([[40.5, 40.5]])
    assert torch.equal(planner.subgoal(states_at(here), there, straight), there)
    assert planner.fallbacks == 1
    assert planner.distance_to_goal(states_at(here), there, straight).item() == pytest.approx(
        straight(states_at(here), there).item()
    )
    said = planner.warning() or ""
    assert "no path" in said
    assert "1 of 1" in said
    assert "planner.tau" in said


def test_with_a_fitting_tau_nothing_is_said() -> None:
    planner = planner_of(GRID, tau=1.5)
    planner.subgoal(states_at(GRID), GRID.flip(0), straight)
    assert planner.metrics()["planner/unconnected"] == 0
    assert planner.warning() is None


def test_a_goal_outside_the_visited_space_is_approached_over_the_nearest_landmark() -> None:
    planner = planner_of(GRID, tau=1.5)
    goal = torch.tensor([30.0, 7.0])
    here = torch.tensor([0.3, 0.2])
    (subgoal,) = planner.subgoal(states_at(here.unsqueeze(0)), goal.unsqueeze(0), straight)
    assert subgoal.tolist() in GRID.tolist()
    path = planner.path(states_at(here.unsqueeze(0))[0], goal, straight)
    assert path[-2].tolist() == [7.0, 7.0]
    assert (walk(planner, here, goal, 60) - goal).norm() < 1e-4  # beyond the map straight on
    assert planner.fallbacks == 0


def test_a_state_far_off_the_map_goes_by_itself() -> None:
    planner = planner_of(GRID, tau=1.5)
    beyond, goal = torch.tensor([[20.0, 7.0]]), torch.zeros(1, 2)
    assert torch.equal(planner.subgoal(states_at(beyond), goal, straight), goal)
    assert planner.fallbacks == 1
    assert torch.equal(planner.path(states_at(beyond)[0], goal[0], straight), goal)


@pytest.mark.parametrize("metric", ["goal", "distance"])
def test_duplicated_states(metric: str) -> None:
    config = PlannerConfig(landmarks=64, candidates=256, tau=1.5, metric=metric)
    planner = LandmarkPlanner(SPEC, config)
    planner.rebuild(states_at(GRID.repeat(4, 1)), straight)
    assert len(planner.map) == 64
    assert planner.insert(states_at(GRID), straight) == 0
    planner.rebuild(states_at(GRID[:1].repeat(100, 1)), straight)
    assert len(planner.map) == 1
    assert (walk(planner, torch.tensor([0.5, 0.0]), GRID[-1], 30) - GRID[-1]).norm() < 1e-4


@pytest.mark.parametrize("selection", ["argmin", "softmax"])
def test_a_single_landmark(selection: str) -> None:
    planner = planner_of(torch.tensor([[1.0, 0.0]]), tau=1.5, selection=selection)
    goals = torch.tensor([[2.0, 0.0], [9.0, 0.0]])
    chosen = planner.subgoal(states_at(torch.zeros(2, 2)), goals, straight)
    assert chosen.tolist() == [[1.0, 0.0]] * 2
    there = torch.tensor([[1.0, 0.0]]).expand(2, 2)
    assert torch.equal(planner.subgoal(states_at(there), goals, straight), goals)
    assert planner.metrics()["planner/unconnected"] == 0
    assert math.isfinite(float(planner.distance_to_goal(states_at(goals), goals, straight).sum()))


def test_no_map_yet() -> None:
    planner = LandmarkPlanner(SPEC, PlannerConfig(tau=1.5))
    goals = torch.tensor([[0.5, 0.0], [9.0, 0.0]])
    assert torch.equal(planner.subgoal(states_at(torch.zeros(2, 2)), goals, straight), goals)
    assert (planner.ready, planner.fallbacks, planner.asked) == (False, 1, 2)
    assert "1 of 2" in (planner.warning() or "")
    with pytest.raises(RPGError, match="no candidates"):
        planner.rebuild(torch.zeros(0, 3), straight)


@pytest.mark.parametrize("wrong", [lambda d: d**2, lambda d: d.clamp_max(5.0) + 0 * d, lambda d: 100 * d])
def test_far_distances_do_not_matter(wrong: object) -> None:
    """A critic right up to tau and wrong beyond, too long or too short, routes like the right one."""

    def learned(state: Tensor, goal: Tensor) -> Tensor:
        steps = straight(state, goal)
        return torch.where(steps <= 1.6, steps, wrong(steps).clamp_min(1.7))  # type: ignore[operator]

    right, misled = planner_of(GRID, tau=1.6), planner_of(GRID, learned, tau=1.6)
    assert torch.equal(right.map.edges, misled.map.edges)
    generator = torch.Generator().manual_seed(0)
    places, goals = (7 * torch.rand(100, 2, generator=generator) for _ in range(2))
    answers = [
        planner.subgoal(states_at(places), goals, distance)
        for planner, distance in ((right, straight), (misled, learned))
    ]
    assert torch.equal(*answers)
    lengths = misled.distance_to_goal(states_at(places), goals, learned)
    torch.testing.assert_close(lengths, right.distance_to_goal(states_at(places), goals, straight))


def test_an_overestimate_everywhere_leaves_the_ways_between_neighbours() -> None:
    """Nothing is within tau, but the shortest ways in are kept, from the state too."""

    def learned(state: Tensor, goal: Tensor) -> Tensor:
        return 50 + straight(state, goal)

    planner = planner_of(GRID, learned, tau=1.5)
    place, goal = torch.tensor([[0.3, 0.2]]), GRID[-1:]
    for _ in range(30):
        subgoal = planner.subgoal(states_at(place), goal, learned)
        way = subgoal - place
        assert float(way.norm()) < 1.5
        place = place + way / way.norm().clamp_min(1.0)
    assert (place - goal).norm() < 1e-4
    assert planner.fallbacks == 0


def test_nan_is_named_and_changes_nothing() -> None:
    planner = planner_of(GRID, tau=1.5)
    before = planner.map.shortest.clone()

    def broken(state: Tensor, goal: Tensor) -> Tensor:
        return straight(state, goal).masked_fill(goal[:, 0] == 3.0, math.nan)

    with pytest.raises(NonFiniteError, match="512 of 4096 distances from landmark to landmark are NaN"):
        planner.rebuild(states_at(GRID), broken)
    with pytest.raises(NonFiniteError, match="8 of 64 distances from state to landmark are NaN"):
        planner.subgoal(states_at(GRID[:1]), GRID[-1:], broken)
    with pytest.raises(NonFiniteError, match="1 of 1 distances from state to goal"):
        planner.path(states_at(GRID[:1])[0], GRID[24], broken)
    with pytest.raises(RPGError, match="at least 0"):
        planner.insert(states_at(GRID[:1] - 5), lambda s, g: -straight(s, g))
    with pytest.raises(NonFiniteError, match="candidate 5 is not finite"):
        planner.rebuild(states_at(GRID).index_fill(0, torch.tensor(5), math.inf), straight)
    assert torch.equal(planner.map.shortest, before)
