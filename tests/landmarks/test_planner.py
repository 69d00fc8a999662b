from __future__ import annotations

import math
from dataclasses import replace

import networkx as nx
import pytest
import torch
from torch import Tensor
from worlds import SPEC, planner_of, states_at, straight, uphill

from rpg.errors import RPGError
from rpg.landmarks import Distance, LandmarkPlanner, PlannerConfig

GRID = torch.cartesian_prod(torch.arange(6.0), torch.arange(6.0))


def scattered(count: int, seed: int) -> Tensor:
    """(count, 2), in a square of 6 units."""
    return 6 * torch.rand(count, 2, generator=torch.Generator().manual_seed(seed))


def whole_graph(planner: LandmarkPlanner, place: Tensor, goal: Tensor, distance: Distance) -> nx.DiGraph:
    """Landmarks 0 to N - 1, ``s`` and ``g``, with the edges that the method's text gives them."""
    tau, graph, places = planner.config.tau, nx.DiGraph(), planner.map.goals
    count = len(places)

    def steps(i: Tensor, j: Tensor) -> float:
        return float(distance(states_at(i.unsqueeze(0)), j.unsqueeze(0)))

    graph.add_nodes_from([*range(count), "s", "g"])
    for j, name in [*enumerate(range(count)), (-1, "g")]:
        target = goal if name == "g" else places[j]
        into = {i: steps(places[i], target) for i in range(count) if i != j}
        limit = max(tau, min(into.values()))
        into["s"] = steps(place, target)
        graph.add_weighted_edges_from((i, name, length) for i, length in into.items() if length <= limit)
    return graph


@pytest.mark.parametrize("distance", [straight, uphill])
@pytest.mark.parametrize("trust_radius", [0.0, 10.0])
def test_argmin_is_that_of_enumeration(distance: Distance, trust_radius: float) -> None:
    planner = planner_of(scattered(40, 0), distance, tau=1.6, trust_radius=trust_radius)
    places, goals = scattered(50, 1), scattered(50, 2)
    chosen = planner.subgoal(states_at(places), goals, distance)
    lengths = planner.distance_to_goal(states_at(places), goals, distance)
    direct = distance(states_at(places), goals)
    near = direct <= min(trust_radius, 1.6)
    lost = 0
    for k, (place, goal) in enumerate(zip(places, goals, strict=True)):
        graph = whole_graph(planner, place, goal, distance)
        to_goal = nx.single_source_dijkstra_path_length(graph.reverse(), "g")
        assert float(lengths[k]) == pytest.approx(to_goal.get("s", float(direct[k])), abs=1e-4)
        over = {n: edge["weight"] + to_goal[n] for n, edge in graph["s"].items() if n in to_goal}
        best = "g" if near[k] or not over else min(over, key=lambda n: over[n])
        assert torch.equal(chosen[k], goal if best == "g" else planner.map.goals[best])
        lost += not near[k] and not over
    assert (~near).sum() - lost > 15
    assert (planner.fallbacks, planner.asked) == (lost, 50)


def test_one_query_of_many_is_many_queries_of_one() -> None:
    planner, alone = (planner_of(GRID, uphill, tau=1.5) for _ in range(2))
    states, goals = states_at(scattered(30, 3)), scattered(30, 4)
    goals[10:20] = goals[:10]  # some share a goal
    together = planner.subgoal(states, goals, uphill)
    one_by_one = [alone.subgoal(states[i : i + 1], goals[i : i + 1], uphill) for i in range(30)]
    assert torch.equal(together, torch.cat(one_by_one))
    assert planner.subgoal(states[:0], goals[:0], uphill).shape == (0, 2)


@pytest.mark.parametrize("distance", [straight, uphill])
def test_the_path_is_a_shortest_one_and_begins_with_the_subgoal(distance: Distance) -> None:
    planner = planner_of(scattered(40, 5), distance, tau=1.6)
    for place, goal in zip(scattered(20, 6), scattered(20, 7), strict=True):
        path = planner.path(states_at(place.unsqueeze(0))[0], goal, distance)
        assert torch.equal(path[-1], goal)
        subgoal = planner.subgoal(states_at(place.unsqueeze(0)), goal.unsqueeze(0), distance)
        assert torch.equal(path[0], subgoal[0])
        stops = torch.cat([place.unsqueeze(0), path])
        length = float(distance(states_at(stops[:-1]), stops[1:]).sum())
        (expected,) = planner.distance_to_goal(states_at(place.unsqueeze(0)), goal.unsqueeze(0), distance)
        if len(path) > 1:
            assert length == pytest.approx(float(expected), abs=1e-4)


def test_softmax_draws_with_the_weights_it_says() -> None:
    """The chances are those of exp(-softness * steps) over what is within tau."""
    corners = torch.tensor([[1.0, 0.6], [1.2, -0.8], [2.5, 0.0], [9.0, 0.0]])
    settings = {"tau": 2.0, "trust_radius": 1.0, "softness": 1.5, "selection": "softmax"}
    planner, count = planner_of(corners, **settings), 20_000
    here, goal = torch.zeros(count, 2), torch.tensor([[3.5, 0.0]]).expand(count, 2)
    torch.manual_seed(0)
    chosen = planner.subgoal(states_at(here), goal, straight)
    usable = corners[:2]  # the third is out of reach, the last too
    over = usable.norm(dim=1) + (usable - corners[2]).norm(dim=1) + 1.0
    expected = torch.softmax(-1.5 * over, dim=0)
    shares = torch.stack([(chosen == landmark).all(dim=1).float().mean() for landmark in usable])
    assert float(shares.sum()) == pytest.approx(1.0)
    assert 0.1 < float(expected.min()) < 0.45
    deviation = (expected * (1 - expected) / count).sqrt()
    assert ((shares - expected).abs() < 4 * deviation).all()


def test_a_landmark_that_is_reached_is_no_subgoal() -> None:
    line = torch.tensor([[float(x), 0.0] for x in range(5)])
    planner = planner_of(line, tau=1.5)
    goal = torch.tensor([[4.0, 0.0]])
    for x in range(3):
        (subgoal,) = planner.subgoal(states_at(line[x : x + 1] + 0.05), goal, straight)
        assert subgoal.tolist() == [x + 1.0, 0.0]


def test_an_edge_longer_than_tau_is_gone_along() -> None:
    """From x = 1 to x = 4 is longer than tau, and the only way: from the landmark before it, near it and after it."""
    line = torch.tensor([[0.0, 0.0], [1.0, 0.0], [4.0, 0.0]])
    planner = planner_of(line, tau=1.5)
    ends = planner.map.edges.isfinite().nonzero()
    assert sorted(planner.map.goals[ends][..., 0].tolist()) == [[0.0, 1.0], [1.0, 0.0], [1.0, 4.0]]
    goal = torch.tensor([[5.0, 0.0]])
    for x, wanted in [(0.4, 1.0), (0.85, 1.0), (0.95, 4.0), (1.0, 4.0), (1.3, 4.0), (2.9, 4.0), (4.0, 5.0)]:
        place = torch.tensor([[x, 0.0]])
        assert planner.subgoal(states_at(place), goal, straight).tolist() == [[wanted, 0.0]]
    assert planner.fallbacks == 0


def test_candidates_in_one_place_are_one_landmark() -> None:
    places = torch.cat([GRID, GRID + 0.05])
    planner = planner_of(places, tau=1.5)
    assert sorted(planner.map.goals.round().tolist()) == sorted(GRID.tolist())
    few = LandmarkPlanner(SPEC, PlannerConfig(landmarks=9, candidates=72, tau=1.5))
    few.rebuild(states_at(places), straight)
    assert torch.equal(few.map.states, planner.map.states[:9])


def test_landmarks_by_the_learned_distance() -> None:
    asked = []

    def counting(state: Tensor, goal: Tensor) -> Tensor:
        asked.append(len(state))
        return uphill(state, goal)

    planner = LandmarkPlanner(SPEC, PlannerConfig(landmarks=6, candidates=36, tau=3.0, metric="distance"))
    planner.rebuild(states_at(GRID), counting)
    assert sum(asked) == 6 * 36
    states, goals = planner.map.states, planner.map.goals
    nearest = torch.stack([uphill(s.expand(36, 3), GRID) for s in states])
    for k in range(1, 6):
        assert float(nearest[:k, :].amin(dim=0).max()) == pytest.approx(
            float(uphill(states[:k], goals[k].expand(k, 2)).min())
        )
    for i, state in enumerate(states):
        assert torch.equal(planner.map.steps[i], uphill(state.expand(6, 3), goals))


@pytest.mark.parametrize("metric", ["goal", "distance"])
def test_a_map_with_room_grows_into_that_of_a_rebuild(metric: str) -> None:
    settings = PlannerConfig(landmarks=40, candidates=40, tau=1.8, metric=metric)
    planner = LandmarkPlanner(SPEC, settings)
    places = scattered(40, 8)
    planner.rebuild(states_at(places[:20]), uphill)
    counted = 0

    def counting(state: Tensor, goal: Tensor) -> Tensor:
        nonlocal counted
        counted += len(state)
        return uphill(state, goal)

    new = planner.insert(states_at(places[20:]), counting)
    held = len(planner.map)
    assert new >= 18
    assert held == 20 + new
    if metric == "goal":
        assert counted == held**2 - 20**2
    pairs = uphill(planner.map.states.repeat_interleave(held, 0), planner.map.goals.repeat(held, 1))
    torch.testing.assert_close(planner.map.steps, pairs.view(held, held))
    expected = LandmarkPlanner(SPEC, settings)
    expected.rebuild(planner.map.states, uphill)
    order = [planner.map.goals.tolist().index(goal) for goal in expected.map.goals.tolist()]
    torch.testing.assert_close(planner.map.shortest[order][:, order], expected.map.shortest)
    assert planner.insert(states_at(places), uphill) == 0


def test_a_full_map_moves_to_where_the_agent_has_come() -> None:
    config = PlannerConfig(landmarks=12, candidates=200, tau=1.5)
    planner = LandmarkPlanner(SPEC, config)
    planner.rebuild(states_at(scattered(200, 9) / 6), straight)
    assert float(planner.map.goals.max()) <= 1.0
    new = planner.insert(states_at(scattered(200, 10)), straight)
    assert 0 < new <= 12
    assert len(planner.map) == 12
    assert float(planner.map.goals.max()) > 5.0
    fresh = LandmarkPlanner(SPEC, config)
    fresh.rebuild(planner.map.states, straight)
    order = [planner.map.goals.tolist().index(goal) for goal in fresh.map.goals.tolist()]
    torch.testing.assert_close(planner.map.shortest[order][:, order], fresh.map.shortest)


def test_ways_to_a_goal_hold_until_the_map_changes() -> None:
    planner = planner_of(GRID, tau=1.5)
    state, goal = states_at(torch.tensor([[0.2, 0.0]])), torch.tensor([[5.0, 0.0]])
    first = planner.distance_to_goal(state, goal, straight)
    asked = []

    def slower(state: Tensor, goal: Tensor) -> Tensor:
        asked.append(len(state))
        return 1.2 * straight(state, goal)

    again = planner.distance_to_goal(state, goal, slower)
    assert sum(asked) == 1 + 36  # to the goal and to the landmarks; none from landmarks to the goal
    assert float(again) == pytest.approx(float(first) + 0.2 * 0.8, abs=1e-4)  # the first leg alone
    planner.rebuild(states_at(GRID), slower)
    assert float(planner.distance_to_goal(state, goal, slower)) == pytest.approx(1.2 * float(first), abs=1e-4)


def test_more_goals_than_are_remembered() -> None:
    planner = planner_of(GRID, tau=1.5)
    states, goals = states_at(scattered(700, 11)), scattered(700, 12)
    at_once = planner.distance_to_goal(states, goals, straight)
    fresh = planner_of(GRID, tau=1.5)
    blocks = zip(states.split(100), goals.split(100), strict=True)
    assert torch.equal(at_once, torch.cat([fresh.distance_to_goal(s, g, straight) for s, g in blocks]))


def test_soft_paths_reach_the_goal_by_longer_ways() -> None:
    exact, soft = (planner_of(scattered(60, 13), tau=1.5, paths=paths) for paths in ("exact", "soft"))
    states, goals = states_at(scattered(20, 14)), scattered(20, 15)
    ratio = soft.distance_to_goal(states, goals, straight) / exact.distance_to_goal(states, goals, straight)
    assert (ratio > 1 - 1e-5).all()
    assert float(ratio.mean()) > 1.05
    assert torch.isfinite(soft.subgoal(states, goals, straight)).all()


def test_state_goes_on_to_the_bit() -> None:
    planner = planner_of(GRID, tau=1.5, selection="softmax")
    states, goals = states_at(scattered(30, 16)), scattered(30, 17)
    planner.subgoal(states, goals, straight)
    loaded = LandmarkPlanner(SPEC, planner.config)
    loaded.load_state_dict(planner.state_dict())
    assert (loaded.asked, loaded.fallbacks, loaded.metrics()) == (30, planner.fallbacks, planner.metrics())

    def later(state: Tensor, goal: Tensor) -> Tensor:
        return 1.1 * straight(state, goal)

    answers = []
    for one in (planner, loaded):
        torch.manual_seed(0)
        answers.append(one.subgoal(states, goals, later))
    assert torch.equal(*answers)
    wide = LandmarkPlanner(replace(SPEC, state_dim=4), planner.config)
    with pytest.raises(RPGError, match="3 entries"):
        wide.load_state_dict(planner.state_dict())


def test_an_infinite_distance_is_no_way() -> None:
    def one_room(state: Tensor, goal: Tensor) -> Tensor:
        """Nothing leads from x < 3 to x >= 3."""
        apart = (SPEC.achieved_goal(state)[:, 0] < 2.5) & (goal[:, 0] > 2.5)
        return straight(state, goal).masked_fill(apart, math.inf)

    planner = planner_of(GRID, one_room, tau=1.5)
    inside = (GRID[:, 0] < 2.5).sum()
    assert int(planner.map.shortest.isinf().sum()) == inside * (36 - inside)
    here, there = torch.tensor([[0.0, 0.0]]), torch.tensor([[5.0, 5.0]])
    assert planner.distance_to_goal(states_at(here), there, one_room).isinf().all()
    assert torch.equal(planner.subgoal(states_at(here), there, one_room), there)
    assert torch.equal(planner.path(states_at(here)[0], there[0], one_room), there)
    assert planner.fallbacks == 1
    assert planner.subgoal(states_at(there), here, one_room).tolist() != here.tolist()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"landmarks": 0}, "planner.landmarks=0"),
        ({"tau": 0.0}, "planner.tau=0.0"),
        ({"tau": math.nan}, "planner.tau=nan"),
        ({"trust_radius": -1.0}, "planner.trust_radius"),
        ({"metric": "l2"}, "goal or distance"),
        ({"selection": "max"}, "argmin or softmax"),
        ({"paths": "short"}, "exact or soft"),
        ({"softness": 0.0}, "planner.softness"),
        ({"rebuild_every": -1}, "planner.rebuild_every"),
        ({"warmup_steps": -1}, "planner.warmup_steps"),
        ({"share": 1.5}, "planner.share"),
        ({"candidates": 50}, "planner.candidates=50"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, object], said: str) -> None:
    with pytest.raises(RPGError, match=said) as refused:
        PlannerConfig(**settings)  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)


def test_what_does_not_fit_is_refused() -> None:
    planner = planner_of(GRID)
    with pytest.raises(RPGError, match=r"\(2, 2\)"):
        planner.rebuild(torch.zeros(2, 2), straight)
    with pytest.raises(RPGError, match="call rebuild first"):
        LandmarkPlanner(SPEC, planner.config).insert(states_at(GRID), straight)
    with pytest.raises(RPGError, match=r"expected \(n, 3\) and \(n, 2\)"):
        planner.subgoal(torch.zeros(2, 3), torch.zeros(1, 2), straight)
    with pytest.raises(RPGError, match="expected"):
        planner.subgoal(torch.zeros(2, 3), torch.ones(2, 2), lambda s, g: straight(s, g).unsqueeze(1))
