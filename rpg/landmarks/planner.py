"""Subgoals on the way to far goals: the planner over the landmark map (thesis Sec. 4.5.4, Algorithm 2)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, inf

from rpg.errors import RPGError
from rpg.goals import GoalSpec
from rpg.landmarks.config import PlannerConfig
from rpg.landmarks.distances import Distance, all_steps, steps_between
from rpg.landmarks.graph import edge_limits
from rpg.landmarks.landmark_map import LandmarkMap
from rpg.landmarks.paths import route


class LandmarkPlanner:
    """Routes over landmarks, for any number of environments at once.

    :meth:`rebuild` makes the map; :meth:`insert` lets new states into it at the price of their own edges. A step
    costs the distances from the state to the goal and, where that is far, to the landmarks. The ways from the
    landmarks to a goal are found once and hold until the map changes.

    Whenever the map knows no way, the answer is the goal itself, so the agent does what it would do without
    a planner; ``fallbacks`` counts these answers and :meth:`warning` says so.

    Args:
        spec: layout of observations. Candidates within ``relabel_radius`` of a landmark are that landmark, and
            a state within it has reached the landmark.
        config: settings.
        device: where the map is kept and all results are.
    """

    def __init__(self, spec: GoalSpec, config: PlannerConfig, device: torch.device | str = "cpu") -> None:
        self.spec, self.config, self.device = spec, config, torch.device(device)
        self.map = LandmarkMap(spec, config, self.device)
        self.asked = 0
        """Subgoals asked for so far."""
        self._fallbacks = torch.zeros((), dtype=torch.int64, device=self.device)

    @property
    def ready(self) -> bool:
        """Whether there is a map."""
        return len(self.map) > 0

    @property
    def fallbacks(self) -> int:
        """Subgoals so far that were the goal itself because no landmark led there."""
        return int(self._fallbacks)

    @torch.no_grad()
    def rebuild(self, states: Tensor, distance: Distance) -> None:
        """Make the map anew of states (n, S), by farthest-point sampling that begins with the first.

        Asks for N^2 distances, or N * n if the metric is ``distance``.

        Raises:
            RPGError: no states, states of another width, or distances that are negative or of another shape.
            NonFiniteError: states that are not finite, or a distance that is NaN.
        """
        self.map.rebuild(states, distance)

    @torch.no_grad()
    def insert(self, states: Tensor, distance: Distance) -> int:
        """Let new states (m, S) into the map: farthest first while there is room for landmarks, then in place of
        those that lie closer together than the new ones lie to the map.

        Asks for 2 N distances a landmark that is let in (with the metric ``distance`` for all states), none
        between old ones. Paths grow in O(N^2) each as long as no old edge goes; else all are found anew.

        Returns:
            How many landmarks are new.

        Raises:
            RPGError, NonFiniteError: as :meth:`rebuild`, or there is no map yet.
        """
        return self.map.insert(states, distance)

    @torch.no_grad()
    def subgoal(self, state: Tensor, goal: Tensor, distance: Distance) -> Tensor:
        """Where to go next from states (n, S) to goals (n, G): (n, G).

        The goal itself where it is nearer than the trust radius and tau. Else the landmark that minimises
        d(s, l) + D(l, g), or the goal where d(s, g) is less. The state is a node of the map for this: an edge
        leads from it to all within tau, and to what no landmark is nearer to. Where it has reached a landmark,
        that one is no step ahead and is left out, and its edges are the state's too; else an agent would
        stand still before an edge that is longer than tau.

        Raises:
            RPGError, NonFiniteError: as :meth:`rebuild`.
        """
        state, goal = self._query(state, goal)
        self.asked += len(state)
        direct = steps_between(distance, state, goal, "state to goal")
        far = (direct > self._trusted).nonzero().squeeze(1)
        chosen = goal.clone()
        if not len(far):
            return chosen
        if not self.ready:
            self._fallbacks += len(far)
            return chosen
        legs, lengths = self._ways(state[far], goal[far], direct[far], distance, ahead=True)
        total = legs + lengths
        lost = total.isinf().all(dim=1)
        self._fallbacks += lost.sum()
        total[:, -1].masked_fill_(lost, 0.0)  # the last column is the goal
        if self.config.selection == "argmin":
            pick = total.argmin(dim=1)
        else:
            pick = torch.softmax(-self.config.softness * total, dim=1).multinomial(1).squeeze(1)
        last = len(self.map)
        landmark = self.map.goals[pick.clamp_max(last - 1)]
        chosen[far] = torch.where((pick == last).unsqueeze(1), goal[far], landmark)
        return chosen

    @torch.no_grad()
    def distance_to_goal(self, state: Tensor, goal: Tensor, distance: Distance) -> Tensor:
        """The planner's own D(s, g) in steps, (n,), for states (n, S) and goals (n, G).

        The length of the shortest way over the map, in which the edge from the state to the goal has its
        place too. Where there is none, the learned distance.

        Raises:
            RPGError, NonFiniteError: as :meth:`rebuild`.
        """
        state, goal = self._query(state, goal)
        direct = steps_between(distance, state, goal, "state to goal")
        if not self.ready or not len(state):
            return direct
        legs, lengths = self._ways(state, goal, direct, distance, ahead=False)
        least = (legs + lengths).amin(dim=1)
        return torch.where(least.isinf(), direct, least)

    @torch.no_grad()
    def path(self, state: Tensor, goal: Tensor, distance: Distance) -> Tensor:
        """The whole shortest way from a state (S,) to a goal (G,): (k, G), the goals of its landmarks, then the goal.

        The goal alone where :meth:`subgoal` answers so.

        Raises:
            RPGError, NonFiniteError: as :meth:`rebuild`.
        """
        state, goal = self._query(state.unsqueeze(0), goal.unsqueeze(0))
        direct = steps_between(distance, state, goal, "state to goal")
        if not self.ready or float(direct) <= self._trusted:
            return goal
        count = len(self.map)
        here, there = count, count + 1  # nodes beside the landmarks
        graph = torch.full((count + 2, count + 2), inf, device=self.device)
        graph[:count, :count] = self.map.edges
        graph[:count, there] = self.map.ways(goal, distance)[0][0]
        legs, _ = self._ways(state, goal, direct, distance, ahead=True)
        graph[here, :count], graph[here, there] = legs[0, :count], legs[0, count]
        stops = route(graph, here, there)[1:-1]
        return torch.cat([self.map.goals[stops], goal])

    def metrics(self) -> dict[str, float]:
        """What to log: landmarks, edges from each, share of pairs without a path, share of answers that fell back."""
        count = len(self.map)
        return {
            "planner/landmarks": float(count),
            "planner/degree": float(self.map.edges.isfinite().sum()) / max(1, count),
            "planner/unconnected": float(self.map.shortest.isinf().sum()) / max(1, count * (count - 1)),
            "planner/fallbacks": self.fallbacks / max(1, self.asked),
        }

    def warning(self) -> str | None:
        """One line on what keeps the planner from helping, for the log, or None."""
        unconnected, told = self.metrics()["planner/unconnected"], []
        if unconnected:
            told.append(f"{unconnected:.0%} of all pairs of landmarks have no path")
        if self.fallbacks:
            told.append(
                f"{self.fallbacks} of {self.asked} subgoals were the goal itself, no landmark led there"
            )
        if not told:
            return None
        return f"planner: {' and '.join(told)}; raise planner.tau={self.config.tau:g} or planner.landmarks"

    def state_dict(self) -> dict[str, Any]:
        """Map, remembered ways and counters."""
        return {"map": self.map.state_dict(), "fallbacks": self.fallbacks, "asked": self.asked}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue, equal to the bit, from :meth:`state_dict`.

        Raises:
            RPGError: landmarks of another width than states have.
        """
        self.map.load_state_dict(state["map"])
        self._fallbacks.fill_(state["fallbacks"])
        self.asked = int(state["asked"])

    @property
    def _trusted(self) -> float:
        return min(self.config.trust_radius, self.config.tau)

    def _ways(
        self, state: Tensor, goal: Tensor, direct: Tensor, distance: Distance, ahead: bool
    ) -> tuple[Tensor, Tensor]:
        """First legs and remaining lengths, (n, N + 1) each: over every landmark, and straight to the goal.

        Legs that may not be used are infinite: those that are no edge, by the rule of all edges, unless an edge
        of a reached landmark stands for them; and if only what lies ``ahead`` counts, those to reached landmarks.
        """
        tau, radius = self.config.tau, self.spec.relabel_radius
        last_edges, lengths = self.map.ways(goal, distance)
        legs = torch.cat(
            [all_steps(distance, state, self.map.goals, "state to landmark"), direct[:, None]], dim=1
        )
        limits = edge_limits(self.map.edges, tau).expand(len(state), -1)
        limits = torch.cat([limits, edge_limits(last_edges.T, tau).unsqueeze(1)], dim=1)
        achieved = self.spec.achieved_goal(state)
        apart = torch.cdist(achieved, self.map.goals, compute_mode="donot_use_mm_for_euclid_dist")  # (n, N)
        least, nearest = apart.min(dim=1, keepdim=True)
        own_edges = torch.cat([self.map.edges[nearest.squeeze(1)], last_edges.gather(1, nearest)], dim=1)
        usable = (legs <= limits) | ((least <= radius) & own_edges.isfinite())
        if ahead:
            usable[:, :-1] &= apart > radius
        return legs.masked_fill(~usable, inf), torch.cat([lengths, torch.zeros_like(least)], dim=1)

    def _query(self, state: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        state, goal = (values.to(self.device, torch.float32) for values in (state, goal))
        if state.shape[1:] != (self.spec.state_dim,) or goal.shape != (len(state), self.spec.goal_dim):
            raise RPGError(
                f"planner: states of shape {tuple(state.shape)} and goals of shape {tuple(goal.shape)}, expected "
                f"(n, {self.spec.state_dim}) and (n, {self.spec.goal_dim})"
            )
        return state, goal
