"""The map: landmark states, the edges between them, and the lengths of all ways over it."""

from __future__ import annotations

import torch
from torch import Tensor, inf

from rpg.errors import NonFiniteError, RPGError
from rpg.goals import GoalSpec
from rpg.landmarks.config import PlannerConfig
from rpg.landmarks.distances import Distance, all_steps
from rpg.landmarks.graph import clip_edges, landmark_edges
from rpg.landmarks.paths import extended_paths, lengths_through, shortest_paths, soft_paths
from rpg.landmarks.sampling import farthest_points, farthest_points_by, members_after

_GOALS = 256  # whose ways are remembered
_SAME_STEPS = 1e-3  # candidates nearer than this by the learned distance are one
_PAIR = "landmark to landmark"


class LandmarkMap:
    """N landmarks, chosen from states and connected by the learned distance.

    A goal is one more node, with edges into it only. The lengths of all ways to a goal are found when it is
    first asked for, and remembered as long as the map stands.

    Args:
        spec: layout of observations. Candidates within ``relabel_radius`` of a landmark are that landmark.
        config: settings.
        device: where everything is kept.
    """

    states: Tensor
    """(N, S)."""
    goals: Tensor
    """(N, G), what the landmarks have achieved."""
    steps: Tensor
    """(N, N), the learned distance from row to column."""
    edges: Tensor
    """(N, N), infinite where there is no edge."""
    shortest: Tensor
    """(N, N), lengths of the shortest paths; infinite without a path."""

    def __init__(self, spec: GoalSpec, config: PlannerConfig, device: torch.device) -> None:
        self.spec, self.config, self.device = spec, config, device
        nothing = torch.zeros(0, 0, device=device)
        self._take(torch.zeros(0, spec.state_dim, device=device), nothing, nothing)

    def __len__(self) -> int:
        return len(self.states)

    def rebuild(self, states: Tensor, distance: Distance) -> None:
        """Make the map of states (n, S); see :meth:`rpg.landmarks.planner.LandmarkPlanner.rebuild`."""
        states = self._candidates(states)
        if not len(states):
            raise RPGError(
                "planner: no candidates for landmarks; rebuild the map once the replay holds states"
            )
        goals, count = self.spec.achieved_goal(states), self.config.landmarks
        if self.config.metric == "goal":
            order = farthest_points(goals.cpu().numpy(), count, self.spec.relabel_radius)
            chosen = torch.as_tensor(order, device=self.device)
            steps = all_steps(distance, states[chosen], goals[chosen], _PAIR)
        else:
            order, rows = farthest_points_by(
                lambda i: (
                    all_steps(distance, states[i : i + 1], goals, "landmark to candidate")[0].cpu().numpy()
                ),
                count,
                _SAME_STEPS,
            )
            chosen = torch.as_tensor(order, device=self.device)
            steps = torch.as_tensor(rows[:, order], device=self.device)
        self._take(states[chosen], steps, self._paths(landmark_edges(steps, self.config.tau)))

    def insert(self, states: Tensor, distance: Distance) -> int:
        """Let in some of states (m, S); see :meth:`rpg.landmarks.planner.LandmarkPlanner.insert`."""
        held = len(self)
        if not held:
            raise RPGError("planner: no map to insert into; call rebuild first")
        pool = torch.cat([self.states, self._candidates(states)])
        steps = torch.full((len(pool), len(pool)), inf, device=self.device)
        steps[:held, :held] = self.steps
        if self.config.metric == "goal":
            goals, gap = self.spec.achieved_goal(pool), self.spec.relabel_radius
            between = torch.cdist(goals, goals, compute_mode="donot_use_mm_for_euclid_dist")
        else:
            between, gap = steps, _SAME_STEPS
            self._ask(steps, pool, torch.arange(len(pool), device=self.device), distance)
        chosen = members_after(between.cpu().numpy(), held, max(held, self.config.landmarks), gap)
        members = torch.as_tensor(chosen, device=self.device)
        new = int((members >= held).sum())
        if not new:
            return 0
        if self.config.metric == "goal":
            self._ask(steps, pool, members, distance)
        steps = steps[members][:, members]
        edges = landmark_edges(steps, self.config.tau)
        # Old paths hold as long as every old edge does: a newcomer may be nearer to a landmark than what was
        # its only, too long way in.
        lost = (self.edges.isfinite() & edges[:held, :held].isinf()).any()
        grown = self.config.paths == "exact" and bool((members[:held] < held).all()) and not bool(lost)
        paths = extended_paths(self.shortest, edges) if grown else self._paths(edges)
        self._take(pool[members], steps, paths)
        return new

    def ways(self, goal: Tensor, distance: Distance) -> tuple[Tensor, Tensor]:
        """Last edges and lengths of the ways from all landmarks to goals (n, G).

        Returns:
            (n, N) edges from the landmarks to the goals, and (n, N) lengths of the shortest ways over the
            map; infinite where there is none.
        """
        unique, inverse = torch.unique(goal, dim=0, return_inverse=True)
        known, place = self._recall(unique)
        new = unique[~known]
        if len(new):
            if len(self._known_goals) + len(new) > _GOALS:
                self._remember(*(held[place[known]] for held in self._memory()))
            edges = clip_edges(all_steps(distance, self.states, new, "landmark to goal"), self.config.tau)
            softness = self.config.softness if self.config.paths == "soft" else None
            fresh = (new, edges.T, lengths_through(self.shortest, edges, softness).T)
            self._remember(*(torch.cat(pair) for pair in zip(self._memory(), fresh, strict=True)))
            place = self._recall(unique)[1]
        rows = place[inverse]
        return self._known_edges[rows], self._known_lengths[rows]

    def state_dict(self) -> dict[str, Tensor]:
        """Everything, remembered ways too."""
        names = ("goals", "edges", "lengths")
        ways = {f"known_{name}": held for name, held in zip(names, self._memory(), strict=True)}
        return {"states": self.states, "steps": self.steps, "shortest": self.shortest} | ways

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue, equal to the bit, from :meth:`state_dict`."""
        state = {name: held.to(self.device) for name, held in state.items()}
        if state["states"].shape[1:] != (self.spec.state_dim,):
            raise RPGError(
                f"planner: saved landmarks have {state['states'].shape[-1]} entries, states of this environment "
                f"{self.spec.state_dim}; load what was saved in the same environment"
            )
        self._take(state["states"], state["steps"], state["shortest"])
        self._remember(state["known_goals"], state["known_edges"], state["known_lengths"])

    def _candidates(self, states: Tensor) -> Tensor:
        states = states.to(self.device, torch.float32)
        if states.dim() != 2 or states.shape[1] != self.spec.state_dim:
            raise RPGError(
                f"planner: candidates have shape {tuple(states.shape)}, expected (n, {self.spec.state_dim}): states "
                "without their goals"
            )
        if not bool(states.isfinite().all()):
            bad = int((~states.isfinite().all(dim=1)).nonzero()[0])
            raise NonFiniteError(
                f"planner: candidate {bad} is not finite; look at the environment's observations"
            )
        return states

    def _ask(self, steps: Tensor, pool: Tensor, members: Tensor, distance: Distance) -> None:
        """Fill in, of the members, the distances that the map does not have yet."""
        held, goals = len(self), self.spec.achieved_goal(pool)
        new, old = members[members >= held], members[members < held]
        steps[new.unsqueeze(1), members] = all_steps(distance, pool[new], goals[members], _PAIR)
        steps[old.unsqueeze(1), new] = all_steps(distance, pool[old], goals[new], _PAIR)

    def _paths(self, edges: Tensor) -> Tensor:
        if self.config.paths == "soft":
            return soft_paths(edges, self.config.softness)
        return shortest_paths(edges)

    def _take(self, states: Tensor, steps: Tensor, shortest: Tensor) -> None:
        """Replace the map and forget the ways over the old one."""
        self.states, self.steps, self.shortest = states, steps, shortest
        self.goals = self.spec.achieved_goal(states)
        self.edges = landmark_edges(steps, self.config.tau) if len(steps) else steps
        none = states.new_zeros(0, len(states))
        self._remember(states.new_zeros(0, self.spec.goal_dim), none, none)

    def _remember(self, goals: Tensor, edges: Tensor, lengths: Tensor) -> None:
        self._known_goals, self._known_edges, self._known_lengths = goals, edges, lengths

    def _memory(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._known_goals, self._known_edges, self._known_lengths

    def _recall(self, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Which of goals (n, G) are remembered, (n,) bool, and where, (n,)."""
        if not len(self._known_goals):
            nowhere = torch.zeros(len(goals), dtype=torch.int64, device=self.device)
            return nowhere.bool(), nowhere
        same = (goals.unsqueeze(1) == self._known_goals).all(dim=-1)  # (n, remembered)
        return same.any(dim=1), same.int().argmax(dim=1)
