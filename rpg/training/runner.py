"""Running an agent in environments: the one code path of training and evaluation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from rpg.agents.agent import Agent
from rpg.envs.base import Restorable
from rpg.errors import NonFiniteError, RPGError


class Transition(NamedTuple):
    """One vector step; arrays have ``num_envs`` rows. ``next_obs`` is the true successor, never a reset."""

    obs: np.ndarray
    action: Tensor
    reward: np.ndarray
    next_obs: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    latent: Tensor


class Episode(NamedTuple):
    """A finished episode: undiscounted return, length in decisions, success at its end and at any time.

    ``score`` is the task's own measure at the end, for tasks that have one (``info["score"]``); ``solved_after`` the
    decisions until the first success.
    """

    ret: float
    length: int
    success_end: bool
    success_ever: bool
    score: float | None = None
    solved_after: int | None = None


class Runner:
    """Steps an agent through vectorised environments and keeps what outlives a step.

    Every episode starts from a seed that depends only on the run's seed, the sub-environment and the
    episode's number, so a run that must start new episodes after a restart still knows which.

    Args:
        agent: acts and draws latents.
        envs: in ``AutoresetMode.DISABLED``.
        seed: of the run.
        name: of the environment, for messages.
    """

    def __init__(self, agent: Agent, envs: VectorEnv[Any, Any, Any], seed: int, name: str = "env") -> None:
        self._agent, self._envs, self._seed, self._name = agent, envs, seed, name
        mode = envs.metadata.get("autoreset_mode")
        if mode is not None and mode != AutoresetMode.DISABLED:
            raise RPGError(
                f"{name}: autoreset mode {mode}; make the environments with "
                'vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED}'
            )
        n = envs.num_envs
        self.num_envs = n
        self._dtype = np.uint8 if agent.frames else np.float32
        # A picture is seen beside those before it; at the start of an episode there is but one.
        self._stack = agent.frames.stack if agent.frames else 1
        self._obs = np.zeros((n, agent.obs_dim), dtype=self._dtype)
        self._latent = torch.zeros(n, agent.latent_dim, device=agent.device)
        self._started = np.zeros(n, dtype=np.int64)  # episodes begun, per environment
        self._seeds = np.zeros(n, dtype=np.int64)  # of the running episodes
        self._return = np.zeros(n)
        self._length = np.zeros(n, dtype=np.int64)
        self._solved = np.zeros(n, dtype=np.int64)  # decisions until the first success; 0: none yet
        self._steps = 0
        space = envs.single_action_space
        self._first_action = int(space.start) if isinstance(space, Discrete) else None

    @property
    def at_boundary(self) -> bool:
        """Whether every environment stands at the first observation of an episode."""
        return not self._length.any()

    @property
    def observations(self) -> np.ndarray:
        """Current observations, (num_envs, obs_dim) float32, of pictures uint8."""
        return self._obs

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Begin new episodes where ``mask`` (num_envs,) is True, or everywhere."""
        mask = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask
        seeds = [
            int(np.random.SeedSequence((self._seed, i, int(k))).generate_state(1)[0])
            for i, k in enumerate(self._started)
        ]
        self._seeds[mask] = np.array(seeds, dtype=np.int64)[mask]
        self._started += mask
        with self._watching_workers():
            obs, _ = self._envs.reset(seed=seeds, options={"reset_mask": mask.copy()})  # type: ignore[arg-type]
        self._return[mask], self._length[mask], self._solved[mask] = 0.0, 0, 0
        first = np.tile(self._checked(obs), self._stack)
        self._obs = first if self._stack == 1 else np.where(mask[:, None], first, self._obs)
        self._latent = self._agent.begin_episodes(self._tensor(self._obs), self._tensor(mask), self._latent)

    def step(self, deterministic: bool = False) -> tuple[Transition, list[Episode]]:
        """Act once everywhere; finished episodes are returned and their environments reset."""
        action = self._agent.act(self._tensor(self._obs), self._latent, deterministic)
        sent = action.cpu().numpy()
        self._require_finite(sent, "action")
        if self._first_action is not None:  # agents count discrete actions from 0, as one float column
            sent = np.rint(sent[:, 0]).astype(np.int64) + self._first_action
        with self._watching_workers():
            next_obs, reward, terminated, truncated, info = self._envs.step(sent)
        self._steps += 1
        next_obs = self._checked(next_obs)
        if self._stack > 1:
            next_obs = np.concatenate([self._obs[:, next_obs.shape[1] :], next_obs], axis=1)
        self._require_finite(reward, "reward")
        transition = Transition(self._obs, action, reward, next_obs, terminated, truncated, self._latent)
        success = np.asarray(info.get("success", info.get("is_success", np.zeros(self.num_envs)))) > 0
        self._return += reward
        self._length += 1
        self._solved = np.where(success & (self._solved == 0), self._length, self._solved)
        ended = np.logical_or(terminated, truncated)
        score = info.get("score")
        episodes = [
            Episode(
                float(self._return[i]),
                int(self._length[i]),
                bool(success[i]),
                bool(self._solved[i]),
                None if score is None else float(score[i]),
                int(self._solved[i]) or None,
            )
            for i in np.flatnonzero(ended)
        ]
        self._obs = next_obs
        if ended.any():
            self.reset(ended)
        return transition, episodes

    @contextmanager
    def _watching_workers(self) -> Iterator[None]:
        """Say which task died where, if a process that steps one did.

        Raises:
            RPGError: it did.
        """
        try:
            yield
        except (EOFError, ConnectionError) as error:
            workers = getattr(self._envs, "processes", [])
            for worker in workers:
                worker.join(1.0)  # its exit code comes a moment after its pipe closed
            codes = [worker.exitcode for worker in workers]
            for worker in workers:
                worker.terminate()
            self._envs.closed = True  # closing would wait for answers that never come
            dead = [i for i, code in enumerate(codes) if code is not None]
            where = "; ".join(
                f"environment {i} (exit code {codes[i]}) after step {int(self._length[i])} of episode "
                f"{int(self._started[i])}, seed {int(self._seeds[i])}"
                for i in dead
            )
            raise RPGError(
                f"{self._name}: a worker process died: {where or error}; the last checkpoint is untouched, "
                "the same command goes on from there"
            ) from error

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, device=self._agent.device)

    def _checked(self, obs: np.ndarray) -> np.ndarray:
        obs = np.asarray(obs, dtype=self._dtype).reshape(self.num_envs, -1)
        if self._dtype == np.float32:
            self._require_finite(obs, "observation")
        return obs

    def _require_finite(self, values: np.ndarray, what: str) -> None:
        if np.isfinite(values).all():
            return
        finite = np.isfinite(values).reshape(self.num_envs, -1).all(1)
        env = int(np.flatnonzero(~finite)[0])
        raise NonFiniteError(
            f"{self._name}: {what} {np.ravel(values[env])[:8].tolist()} of environment {env} is not finite "
            f"(vector step {self._steps}, episode {int(self._started[env])}, seed {self._seed}); "
            "the last checkpoint is untouched"
        )

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data only; ``env`` is None where the environments cannot be restored."""
        env = self._envs.get_state() if isinstance(self._envs, Restorable) else None
        return {
            "obs": torch.from_numpy(self._obs.copy()),
            "latent": self._latent.clone(),
            "started": torch.from_numpy(self._started.copy()),
            "return": torch.from_numpy(self._return.copy()),
            "length": torch.from_numpy(self._length.copy()),
            "solved": torch.from_numpy(self._solved.copy()),
            "steps": self._steps,
            "env": None if env is None else {k: torch.as_tensor(v) for k, v in env.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> bool:
        """Continue from :meth:`state_dict`.

        Returns:
            True if episodes go on where they were; False if the environments could not be restored and
            new episodes were begun from the next recorded seeds.
        """
        self._started = state["started"].numpy().copy()
        self._steps = state["steps"]
        if state["env"] is None or not isinstance(self._envs, Restorable):
            length = state["length"].numpy()
            # An episode that was begun but not stepped is begun again with its own seed.
            self._started = self._started - (length == 0)
            self.reset()
            return False
        self._envs.reset()
        self._envs.set_state({k: v.numpy() for k, v in state["env"].items()})
        self._obs = state["obs"].numpy().copy()
        self._latent = state["latent"].to(self._agent.device)
        self._return = state["return"].numpy().copy()
        self._length = state["length"].numpy().copy()
        self._solved = state["solved"].numpy().copy()
        return True


def summarize(episodes: list[Episode], prefix: str) -> dict[str, float]:
    """Mean return, length, success rates and, where there is one, score under ``prefix``; empty without episodes."""
    if not episodes:
        return {}
    columns = np.array([[e.ret, e.length, e.success_end, e.success_ever] for e in episodes], dtype=float)
    names = ("return", "length", "success_end", "success_ever")
    means = {f"{prefix}/{name}": float(v) for name, v in zip(names, columns.mean(0), strict=True)}
    scores = [e.score for e in episodes if e.score is not None]
    return means | ({f"{prefix}/score": float(np.mean(scores))} if scores else {})


def evaluate(
    agent: Agent,
    envs: VectorEnv[Any, Any, Any],
    episodes: int,
    seed: int,
    deterministic: bool,
    name: str = "env",
    planning: bool = True,
) -> list[Episode]:
    """Run whole episodes from fixed seeds without touching any random state of training.

    Args:
        agent: the one to judge.
        envs: used for this only; reset here.
        episodes: how many to run; the same number per sub-environment, rounded up, so that short
            episodes are not over-represented.
        seed: of the evaluation; equal seeds give equal episodes.
        deterministic: take the mode of pi(a|s, z) instead of a sample. z is drawn either way.
        name: of the environment, for messages.
        planning: whether a planner is asked, if the agent has one.
    """
    per_env = -(-episodes // envs.num_envs)
    devices = [agent.device] if agent.device.type == "cuda" else []
    finished: list[Episode] = []
    with agent.evaluating(planning), torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        runner = Runner(agent, envs, seed, name)
        runner.reset()
        counts = np.zeros(envs.num_envs, dtype=np.int64)
        while (counts < per_env).any():
            transition, ended = runner.step(deterministic)
            rows = np.flatnonzero(np.logical_or(transition.terminated, transition.truncated))
            for row, episode in zip(rows, ended, strict=True):
                if counts[row] < per_env:
                    finished.append(episode)
                counts[row] += 1
    return finished
