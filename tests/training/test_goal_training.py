"""Goal-conditioned agents through the ordinary commands, with and without a planner."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import DictConfig
from resuming import assert_equal_runs, interrupt

from rpg.envs.goal_grid import FourRoomVectorEnv
from rpg.errors import RPGError
from rpg.evaluate import evaluate_run
from rpg.train import train
from rpg.training.build import build_trainer, parse_config
from rpg.training.distances import distance_errors
from rpg.training.loggers import read_rows

Composed = Callable[..., DictConfig]

SHORT = (
    "experiment=debug",
    "trainer.steps=300",
    "trainer.seed_decisions=40",
    "trainer.log_every=50",
    "trainer.checkpoint_every=100",
    "trainer.eval_every=150",
    "trainer.eval_episodes=2",
    "trainer.eval_envs=2",
    "trainer.decisions_per_update=10",
    "trainer.picture_every=0",
)
MAP = (
    "planner=landmarks",
    "planner.landmarks=8",
    "planner.candidates=20",
    "planner.warmup_steps=60",
    "planner.share=0.5",
)
TASKS = {
    "four_room": ("agent=dqn_her", "env=four_room", "+env.kwargs.episode_steps=20"),
    "reach_2d": ("agent=ddpg_her", "env=reach_2d", "+env.kwargs.episode_steps=20"),
}


@pytest.mark.parametrize("planner", [False, True], ids=["her", "planner"])
@pytest.mark.parametrize("task", TASKS)
def test_a_resumed_run_equals_an_uninterrupted_one(
    composed: Composed, tmp_path: Path, task: str, planner: bool
) -> None:
    settings = (*SHORT, *TASKS[task], *(MAP if planner else ()))
    straight = composed(*settings)
    straight.run_dir = str(tmp_path / "straight")
    row = train(straight)
    modes = {"planner", "her"} if planner else {"her"}
    assert {key.split("/")[1] for key in row if key.startswith("eval/")} == modes
    assert row["updates"] > 0
    assert np.isfinite(row["loss/value"])
    if planner:
        assert 0.2 < row["planner/share"] < 0.5  # of the steps after the warm-up a half
        assert row["planner/landmarks"] > 1
    resumed = composed(*settings, f"run_dir={tmp_path / 'resumed'}")
    interrupt(resumed, 175)
    train(resumed)
    assert_equal_runs(tmp_path / "resumed", tmp_path / "straight")


@pytest.mark.parametrize("task", TASKS)
def test_evaluations_and_pictures_do_not_change_what_is_trained(
    composed: Composed, tmp_path: Path, task: str
) -> None:
    losses = []
    for every in (0, 100):
        intervals = (f"trainer.eval_every={every}", f"trainer.picture_every={every}")
        cfg = composed(*SHORT, *TASKS[task], *MAP, *intervals)
        cfg.run_dir = str(tmp_path / f"every{every}")
        train(cfg)
        pictures = sorted(path.name for path in (tmp_path / f"every{every}").glob("pictures/map_*.png"))
        assert pictures == [f"map_{step:09d}.png" for step in ((100, 200, 300) if every else ())]
        found = read_rows(tmp_path / f"every{every}" / "metrics.jsonl")
        losses.append([row["loss/value"] for row in found if "loss/value" in row])
    assert len(losses[0]) > 2
    assert losses[0] == losses[1]


def test_a_trained_run_is_judged_with_the_map_of_its_replay(composed: Composed, tmp_path: Path) -> None:
    cfg = composed(*SHORT, *TASKS["reach_2d"], *MAP, "trainer.eval_every=0")
    train(cfg)
    first = evaluate_run(tmp_path / "run", 2, seed=5)
    assert {key.split("/")[1] for key in first} == {"planner", "her"}
    assert evaluate_run(tmp_path / "run", 2, seed=5) == first


@pytest.mark.long
def test_finds_its_way_through_four_rooms(composed: Composed, tmp_path: Path) -> None:
    cfg = composed(
        *TASKS["four_room"][:2], "planner=landmarks", "compile=false", "trainer.steps=16000",
        "trainer.eval_every=4000", "trainer.eval_episodes=100", "trainer.eval_envs=100",
        "+env.eval_kwargs.episode_steps=40", "trainer.picture_every=8000",
    )  # fmt: skip
    row = train(cfg)
    found = [row for row in read_rows(tmp_path / "run" / "metrics.jsonl") if "eval/her/distortion" in row]
    for mode in ("planner", "her"):
        assert row[f"eval/{mode}/success_ever"] > 0.6, found
        assert row[f"eval/{mode}/distortion"] < 0.25, found
        assert found[0][f"eval/{mode}/distortion"] > 2 * row[f"eval/{mode}/distortion"]


# -- stopping early ------------------------------------------------------------------------------------


def judged(trainer: Any, successes: list[float]) -> list[bool]:
    """Whether the run is over after each of the evaluations."""
    over = []
    for success in successes:
        trainer._judge({"eval/her/success_end": success})
        over.append(trainer.finished)
    return over


def test_a_run_ends_after_three_good_evaluations_in_a_row(composed: Composed) -> None:
    trainer = build_trainer(
        parse_config(composed(*SHORT, *TASKS["reach_2d"], "trainer.stop_at_success=0.95"))
    )
    assert judged(trainer, [1.0, 0.95, 0.9, 1.0, 1.0, 0.96]) == [False] * 5 + [True]
    never = build_trainer(parse_config(composed(*SHORT, *TASKS["reach_2d"])))
    assert judged(never, [1.0] * 5) == [False] * 5


def test_a_run_that_stopped_early_stays_so(composed: Composed, tmp_path: Path) -> None:
    # Everything within 9 of the goal is success, so an evaluation can hardly fail.
    easy = ("+env.kwargs.success_radius=99.0", "trainer.stop_at_success=0.95", "trainer.eval_every=50")
    cfg = composed(*SHORT, *TASKS["reach_2d"], *easy)
    assert train(cfg)["env_steps"] == 150
    assert train(cfg)["env_steps"] == 150
    assert build_trainer(parse_config(cfg)).resume()


@pytest.mark.parametrize("value", ["0", "1.5", "nan"])
def test_an_impossible_mark_is_refused(composed: Composed, value: str) -> None:
    with pytest.raises(RPGError, match="trainer.stop_at_success"):
        parse_config(composed(f"trainer.stop_at_success={value}"))


# -- true distances ------------------------------------------------------------------------------------


def test_distortion_compares_all_pairs_with_the_truth(composed: Composed) -> None:
    trainer = build_trainer(parse_config(composed(*SHORT, *TASKS["four_room"])))
    envs = FourRoomVectorEnv(1)
    agent: Any = trainer.agent
    cells = {tuple(state): i for i, state in enumerate(envs.states.tolist())}

    def known(state: Any, goal: Any) -> Any:
        index = [[cells[tuple(row)] for row in part.tolist()] for part in (state, goal)]
        assert len(index[0]) == 56 * 55
        return agent.critic.nets.w1.new_tensor(1.5 * envs.distances()[tuple(index)])

    agent.distance = known
    assert distance_errors(agent, envs) == pytest.approx(
        {"eval/her/distortion": 0.5, "eval/her/max_distance": 24.0}
    )


# -- what is refused -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("agent=sac", "env=reach_2d", "planner=landmarks"), "agent=sac has no goals"),
        (("agent=ddpg_her", "env=maze"), "has no goals"),
        (("agent=ddpg_her", "env=reach_2d", "exploration=rnd"), "exploration=rnd"),
        (("agent=ddpg_her", "env=four_room"), "continuous actions"),
        (("agent=dqn_her", "env=reach_2d"), "dqn_her"),
        (("agent=ddpg_her", "env=reach_2d", "planner=landmarks", "planner.tau=0"), "planner.tau=0"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    composed: Composed, overrides: tuple[str, ...], message: str
) -> None:
    with pytest.raises(RPGError) as caught:
        build_trainer(parse_config(composed("experiment=debug", *overrides)))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_bonus_is_added_unless_asked_for(composed: Composed) -> None:
    run = parse_config(composed("agent=ddpg_her", "env=reach_2d"))
    assert run.exploration_name == "none"
    assert parse_config(composed("agent=sac", "env=reach_2d")).exploration_name == "rnd"
