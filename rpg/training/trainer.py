"""The training loop: collect, learn, tell, survive."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from rpg import compiling
from rpg.agents.agent import Agent
from rpg.envs.base import Restorable, Tracked
from rpg.errors import NonFiniteError, RPGError
from rpg.exploration import ExplorationBonus
from rpg.training.checkpoint import load_checkpoint, save_checkpoint
from rpg.training.config import TrainerConfig
from rpg.training.distances import distance_errors
from rpg.training.hindsight import make_replay
from rpg.training.loggers import Loggers
from rpg.training.map_picture import map_picture
from rpg.training.replay import Shares
from rpg.training.runner import Episode, Runner, evaluate, summarize
from rpg.training.video import film

Row = dict[str, float | int | str]

_IN_A_ROW = 3  # evaluations that must succeed before a run stops early
_EVALUATION_SEED = 1_000_000  # added to the run's seed, so that evaluation does not replay training episodes


class Trainer:
    """Trains one agent in one batch of environments, resumably.

    Args:
        agent: acts and learns.
        exploration: bonus on sampled segments; None for none.
        envs: training environments.
        eval_envs: makes a separate batch for evaluation when first needed.
        film_envs: makes a single environment that draws, for videos.
        config: the loop.
        run_dir: logs, pictures and the checkpoint go here.
        loggers: where rows and pictures go.
        seed: of the run.
        plain_config: the whole run's settings as plain data, stored in the checkpoint.
        env_name: for messages.
        action_repeat: env steps per decision.
    """

    def __init__(
        self,
        agent: Agent,
        exploration: ExplorationBonus | None,
        envs: VectorEnv[Any, Any, Any],
        eval_envs: Callable[[], VectorEnv[Any, Any, Any]],
        config: TrainerConfig,
        run_dir: Path,
        loggers: Loggers,
        seed: int,
        plain_config: dict[str, Any] | None = None,
        env_name: str = "env",
        action_repeat: int = 1,
        film_envs: Callable[[], VectorEnv[Any, Any, Any]] | None = None,
    ) -> None:
        self.agent, self.exploration, self.config = agent, exploration, config
        self.checkpoint_path = run_dir / "checkpoint.pt"
        self._make_eval_envs, self._make_film_envs = eval_envs, film_envs
        self._run_dir = run_dir
        self._eval_envs: VectorEnv[Any, Any, Any] | None = None
        self._loggers, self._seed, self._plain = loggers, seed, plain_config or {}
        self._env_name, self._repeat = env_name, action_repeat
        self._envs, self._restorable = envs, isinstance(envs, Restorable)
        if config.novel_fraction and exploration is None:
            raise RPGError(
                f"trainer.novel_fraction={config.novel_fraction}: novelty is judged by an exploration bonus; "
                "choose exploration=rnd, or 0"
            )
        self._runner = Runner(agent, envs, seed, env_name)
        with_bonus = exploration is not None and not exploration.config.relabel
        self._replay = make_replay(
            agent, envs.num_envs, config.replay_capacity, with_bonus, prioritized=config.novel_fraction > 0
        )
        self._shares = Shares(config.recent_fraction, config.recent_window, config.novel_fraction)
        agent.connect(self._replay)
        self._tracker = envs.make_tracker() if isinstance(envs, Tracked) else None
        self.decisions = self.updates = self._ticks = 0
        self._sums: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}
        self._episodes: list[Episode] = []
        self._last_row: Row = {}
        self._due_checkpoint = self._started = False
        self._saved_at = 0  # decisions
        self._successes = 0  # evaluations in a row that reached stop_at_success
        self._wall_before, self._clock = 0.0, time.perf_counter()
        self._speed = (0, 0, 0.0)  # decisions, updates, wall_s at the last log row

    @property
    def env_steps(self) -> int:
        """Simulator steps so far, action repeat included."""
        return self.decisions * self._repeat

    @property
    def wall_s(self) -> float:
        """Seconds of training, summed over restarts."""
        return self._wall_before + time.perf_counter() - self._clock

    @property
    def finished(self) -> bool:
        """Whether the run is over: all its steps are done, or it succeeds often enough to stop early."""
        return self.env_steps >= self.config.steps or self._successes >= _IN_A_ROW

    def compile(self) -> None:
        """Compile the learning step: agent and exploration."""
        self.agent.compile()
        if self.exploration is not None:
            self.exploration.compile()

    def train(
        self,
        should_stop: Callable[[], bool] = lambda: False,
        on_row: Callable[[Row], None] = lambda row: None,
    ) -> Row:
        """Run until :attr:`finished`, or until ``should_stop`` asks to; either way a checkpoint is written.

        Args:
            should_stop: looked at after every vector step.
            on_row: receives every log row, for a progress display.

        Returns:
            The last row logged.
        """
        self._clock = time.perf_counter()
        if not self._started:
            self.start()
        while not self.finished and not should_stop():
            self.collect_once()
            while self._ticks < self._ticks_due():
                self._ticks += 1
                self.learn_once()
            if self._due(self.config.eval_every):
                self._evaluate()
            if self._due(self.config.video_every):
                self.film()
            if self._due(self.config.log_every):
                on_row(self._log())
            if self._due(self.config.picture_every) and not self.finished:  # then both follow below
                self.draw()
            self._due_checkpoint |= self._due(self.config.checkpoint_every) and not self.finished
            if self._due_checkpoint and self._may_save():
                self.save()
        if self.finished and self.config.picture_every:
            self.draw()
        self.save()
        return self._last_row

    def close(self) -> None:
        """Flush the loggers and end environments that run in other processes."""
        self._loggers.close()
        for envs in (self._envs, self._eval_envs):
            if envs is not None:
                envs.close()

    def _due(self, every: int) -> bool:
        """Whether the last vector step reached a multiple of ``every`` env steps, or the end."""
        if not every:
            return False
        before = self.env_steps - self._runner.num_envs * self._repeat
        return self.env_steps // every > before // every or self.env_steps >= self.config.steps > before

    # -- collect and learn -----------------------------------------------------------------------------

    def start(self) -> None:
        """Begin the first episodes, and the logs with them: a run killed before its first checkpoint left some."""
        self._started = True
        self._loggers.rewind(0)
        self._runner.reset()
        self._watch(self._runner.observations)

    def collect_once(self) -> None:
        """Act once in every environment and store what happened."""
        transition, episodes = self._runner.step()
        bonus = None
        if self.exploration is not None and not self.exploration.config.relabel:
            bonus = self.exploration.of_transition(
                self._tensor(transition.obs), transition.action, self._tensor(transition.next_obs)
            )
        self._replay.add(*transition, bonus)
        self._watch(transition.next_obs)
        if episodes:
            begun = np.logical_or(transition.terminated, transition.truncated)
            self._watch(self._runner.observations[begun])
            self._episodes += episodes
        self.decisions += self._runner.num_envs

    def _watch(self, observations: np.ndarray) -> None:
        if self._tracker is not None:
            self._tracker.observe(observations)
        if self.exploration is not None:
            self.exploration.observe(self._tensor(observations))

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, device=self.agent.device)

    def _ticks_due(self) -> int:
        if not self.config.decisions_per_update or not self.agent.batch_size:
            return 0
        return int(self.decisions / self.config.decisions_per_update + 1e-9)

    def learn_once(self) -> None:
        """One update of the exploration bonus and, once enough is stored, of the agent."""
        if self.exploration is not None and self.exploration.ready:
            self._add(self.exploration.update(self._replay))
        if self.decisions > self.config.seed_decisions:
            self.update_agent()

    def update_agent(self) -> None:
        """Sample segments, judge their novelty as it is now, and let the agent learn from them."""
        batch = self._replay.sample(self.agent.batch_size, self.agent.horizon, self._shares)
        if self.exploration is not None and self.exploration.config.relabel:
            batch = self.exploration.relabel(batch)
        if self._replay.priorities is not None and batch.place is not None and batch.bonus is not None:
            self._replay.priorities.judge(batch.place, batch.bonus.amax(0))
            batch = batch._replace(place=None)
        self._add(self.agent.update(batch, self.env_steps))
        self.updates += 1

    def _add(self, metrics: dict[str, Tensor]) -> None:
        # Sums stay on the device; they are read once per log row.
        for key, value in metrics.items():
            self._sums[key] = self._sums[key] + value if key in self._sums else value.clone()
            self._counts[key] = self._counts.get(key, 0) + 1

    # -- tell ------------------------------------------------------------------------------------------

    def _progress(self) -> Row:
        return {
            "decisions": self.decisions,
            "env_steps": self.env_steps,
            "updates": self.updates,
            "wall_s": round(self.wall_s, 3),
        }

    def _log(self) -> Row:
        row = self._progress()
        if self._tracker is not None:
            row |= {f"train/{k}": v for k, v in self._tracker.metrics().items()}
        row |= summarize(self._episodes, "train") | self.agent.report()
        means = {key: float(self._sums[key]) / self._counts[key] for key in sorted(self._sums)}
        row |= means
        wall = self.wall_s
        elapsed = max(wall - self._speed[2], 1e-9)
        row["time/env_steps_per_s"] = (self.decisions - self._speed[0]) * self._repeat / elapsed
        row["time/updates_per_s"] = (self.updates - self._speed[1]) / elapsed
        if compiling.LOG.seconds:
            row["time/compile_s"] = round(sum(compiling.LOG.seconds.values()), 3)  # of this process
        self._speed = (self.decisions, self.updates, wall)
        self._sums, self._counts, self._episodes = {}, {}, []
        self._loggers.log(row, self.env_steps)
        self._last_row = self._last_row | row
        bad = [key for key, value in means.items() if not np.isfinite(value)]
        if bad:
            raise NonFiniteError(
                f"{self._env_name}: {', '.join(bad)} became non-finite by env step {self.env_steps} "
                f"(seed {self._seed}); the last checkpoint is untouched, lower the learning rate or look at "
                "the rewards"
            )
        return row

    def _evaluate(self) -> None:
        envs = self._evaluation_envs()
        row = self._progress()
        for mode, deterministic, planning in self.agent.evaluations:
            episodes = evaluate(
                self.agent,
                envs,
                self.config.eval_episodes,
                self._seed + _EVALUATION_SEED,
                deterministic,
                self._env_name,
                planning,
            )
            row |= summarize(episodes, f"eval/{mode}")
        row |= distance_errors(self.agent, envs)
        self._loggers.log(row, self.env_steps)
        self._last_row = self._last_row | row
        self._judge(row)

    def _evaluation_envs(self) -> VectorEnv[Any, Any, Any]:
        if self._eval_envs is None:
            self._eval_envs = self._make_eval_envs()
        return self._eval_envs

    def _judge(self, row: Row) -> None:
        """Count evaluations in a row that reach ``stop_at_success``."""
        if self.config.stop_at_success is not None:
            success = float(row[f"eval/{self.agent.evaluations[0].name}/success_end"])
            self._successes = self._successes + 1 if success >= self.config.stop_at_success else 0

    def draw(self) -> None:
        """Write the tracker's picture of progress and that of the agent's map, if there are such."""
        picture = self._tracker.picture() if self._tracker is not None else None
        if picture is not None:
            self._loggers.picture("progress", picture, self.env_steps)
        if self.agent.hindsight is not None:
            chart = map_picture(self.agent, self._evaluation_envs(), self._seed + _EVALUATION_SEED)
            if chart is not None:
                self._loggers.picture("map", chart, self.env_steps)

    def film(self) -> None:
        """Write a video of an evaluation episode into the run folder, if there is an environment for it."""
        if self._make_film_envs is None:
            return
        with closing(self._make_film_envs()) as envs:
            path = self._run_dir / "videos" / f"{self.env_steps:09d}.mp4"
            film(self.agent, envs, path, 1, self._seed + _EVALUATION_SEED, name=self._env_name)

    # -- survive ---------------------------------------------------------------------------------------

    def _may_save(self) -> bool:
        """Episodes of a simulator that cannot be restored are not torn apart, unless they never align."""
        overdue = (self.decisions - self._saved_at) * self._repeat >= 2 * self.config.checkpoint_every
        return self._restorable or self._runner.at_boundary or overdue

    def save(self) -> None:
        """Write the checkpoint; refuses if learning has gone non-finite since the last one."""
        bad = [key for key, value in self._sums.items() if not bool(value.isfinite())]
        if bad:
            raise NonFiniteError(
                f"{self._env_name}: {', '.join(bad)} became non-finite by env step {self.env_steps} "
                f"(seed {self._seed}); no checkpoint was written, the previous one is untouched"
            )
        save_checkpoint(self.checkpoint_path, self.state_dict())
        self._due_checkpoint, self._saved_at = False, self.decisions

    def state_dict(self) -> dict[str, Any]:
        """Everything the run depends on, as tensors and plain data."""
        tracker = self._tracker.state_dict() if self._tracker is not None else {}
        cuda = self.agent.device.type == "cuda"
        return {
            "config": self._plain,
            "decisions": self.decisions,
            "env_steps": self.env_steps,
            "updates": self.updates,
            "ticks": self._ticks,
            "wall_s": self.wall_s,
            "agent": self.agent.state_dict(),
            "exploration": self.exploration.state_dict() if self.exploration is not None else {},
            "replay": self._replay.state_dict(),
            "runner": self._runner.state_dict(),
            "episode_state": self.agent.episode_state(),
            "tracker": {
                k: torch.as_tensor(v) if isinstance(v, np.ndarray) else v for k, v in tracker.items()
            },
            "sums": dict(self._sums),
            "counts": dict(self._counts),
            "episodes": [tuple(e) for e in self._episodes],
            "last_row": dict(self._last_row),
            "successes": self._successes,
            "rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state(self.agent.device) if cuda else None,
        }

    def resume(self) -> bool:
        """Continue from this run's checkpoint.

        Returns:
            True if running episodes were restored too; False if new ones had to begin.
        """
        state = load_checkpoint(self.checkpoint_path)  # on the CPU; every part moves its own
        self.decisions, self.updates, self._ticks = state["decisions"], state["updates"], state["ticks"]
        self._started, self._saved_at = True, self.decisions
        self._wall_before, self._clock = state["wall_s"], time.perf_counter()
        self._speed = (self.decisions, self.updates, self._wall_before)
        self.agent.load_state_dict(state["agent"])
        if self.exploration is not None:
            self.exploration.load_state_dict(state["exploration"])
        self._replay.load_state_dict(state["replay"])
        if self._tracker is not None:
            self._tracker.load_state_dict(
                {k: v.numpy() if isinstance(v, Tensor) else v for k, v in state["tracker"].items()}
            )
        self._sums, self._counts = state["sums"], state["counts"]
        self._episodes = [Episode(*e) for e in state["episodes"]]
        self._last_row, self._successes = state["last_row"], state["successes"]
        self.agent.restore_episode_state(state["episode_state"])
        torch.set_rng_state(state["rng"])
        if state["cuda_rng"] is not None:
            torch.cuda.set_rng_state(state["cuda_rng"], self.agent.device)
        restored = self._runner.load_state_dict(state["runner"])
        if not restored:
            self._replay.cut()
            self._watch(self._runner.observations)
        self._loggers.rewind(self.env_steps)
        return restored
