from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from omegaconf import DictConfig, OmegaConf

import rpg.conf
from rpg.agents import GoalDDPGConfig, GoalDQNConfig, RPGConfig, SACConfig, TDMPCConfig
from rpg.envs.registration import register_all
from rpg.exploration import Plan2ExploreConfig, RNDConfig
from rpg.landmarks.config import PlannerConfig
from rpg.train import train
from rpg.training.build import parse_config
from rpg.training.config import LoggerConfig, TrainerConfig

Composed = Callable[..., DictConfig]

CONF = Path(rpg.conf.__file__).parent
AGENTS = sorted(p.stem for p in (CONF / "agent").glob("*.yaml"))
# Variants are RPG's alone, methods choose the agent themselves; both are tested with their figures. Task ids belong to
# their adapters.
OPTIONS = sorted(
    (p.parent.name, p.stem)
    for p in CONF.glob("*/*.yaml")
    if p.parent.name not in ("agent", "ablation", "method", "task_id") and not p.stem.startswith("fig3")
)
GOALS = ["ddpg_her", "dqn_her"]  # run in environments of their own, tests/training/test_goal_training.py
# What tells from a log row that an agent learned.
LEARNERS = {
    "rpg": "loss/state",
    "mbsac": "loss/state",
    "sac": "train/critic_grad_norm",
    "tdmpc": "loss/state",
}


@pytest.mark.parametrize(("group", "option"), OPTIONS, ids=[f"{g}={o}" for g, o in OPTIONS])
def test_every_option_goes_with_every_agent(composed: Composed, group: str, option: str) -> None:
    for agent in AGENTS:
        run = parse_config(composed(f"agent={agent}", f"{group}={option}"))
        assert run.agent_name == agent


def test_paper_sizes_are_the_defaults_in_code(composed: Composed) -> None:
    run = parse_config(composed("agent=rpg", "size=paper", "env=bandit"))
    assert run.agent == replace(RPGConfig(), obs_scale=1.0)  # 0.01 is for mazes
    assert run.exploration == RNDConfig()
    assert run.trainer == TrainerConfig()


def test_published_maze_is_the_defaults_in_code(composed: Composed) -> None:
    run = parse_config(composed("agent=rpg", "experiment=published"))
    assert run.agent == replace(RPGConfig(), beta=0.01)  # 0.005 is for the other tasks
    assert run.exploration == RNDConfig()
    assert run.env.name == "maze"


def test_paper_sizes_of_the_baselines_are_the_defaults_in_code(composed: Composed) -> None:
    for agent, defaults in (
        ("sac", SACConfig()),
        ("tdmpc", TDMPCConfig()),
        ("ddpg_her", GoalDDPGConfig()),
        ("dqn_her", GoalDQNConfig()),
    ):
        run = parse_config(composed(f"agent={agent}", "size=paper", "env=gymnasium"))
        assert run.agent == defaults
    run = parse_config(composed("exploration=plan2explore", "size=paper", "env=gymnasium"))
    assert run.exploration == Plan2ExploreConfig()


def test_default_logger_is_the_one_in_code(composed: Composed) -> None:
    assert parse_config(composed("logger=tensorboard")).logger == LoggerConfig()


def test_mbsac_is_rpg_without_a_latent(composed: Composed) -> None:
    rpg, mbsac = (parse_config(composed(f"agent={name}")).agent for name in ("rpg", "mbsac"))
    assert mbsac == replace(rpg, latent=replace(rpg.latent, gaussian=0, categories=0))


def leaves(tree: Any, prefix: str = "") -> set[str]:
    if not isinstance(tree, dict) or not tree:
        return {prefix}
    return {leaf for key, sub in tree.items() for leaf in leaves(sub, f"{prefix}.{key}")}


def test_every_setting_can_be_given_on_the_command_line(composed: Composed) -> None:
    def settings(*overrides: str) -> dict[str, Any]:
        cfg = OmegaConf.to_container(composed(*overrides), resolve=True)
        assert isinstance(cfg, dict)
        return cfg

    cfg = settings("agent=rpg")
    agent = cfg["agent"] | {"world_model": cfg["world_model"]}
    assert leaves(agent) == leaves(asdict(RPGConfig())) | {".name"}
    assert leaves(settings("agent=sac")["agent"]) == leaves(asdict(SACConfig())) | {".name"}
    assert leaves(settings("agent=tdmpc")["agent"]) == leaves(asdict(TDMPCConfig())) | {".name"}
    assert leaves(settings("agent=ddpg_her")["agent"]) == leaves(asdict(GoalDDPGConfig())) | {".name"}
    assert leaves(settings("agent=dqn_her")["agent"]) == leaves(asdict(GoalDQNConfig())) | {".name"}
    planner = settings("planner=landmarks")["planner"]
    assert leaves(planner) == leaves(asdict(PlannerConfig())) | {".name"}
    for bonus, defaults in (("rnd", RNDConfig()), ("plan2explore", Plan2ExploreConfig())):
        assert leaves(settings(f"exploration={bonus}")["exploration"]) == leaves(asdict(defaults)) | {".name"}
    assert leaves(cfg["trainer"]) == leaves(asdict(TrainerConfig()))


def test_environment_settings_reach_the_agent(composed: Composed) -> None:
    run = parse_config(composed("env=gymnasium", "env.reward_scale=5", "env.obs_scale=0.5"))
    assert (run.agent.reward_scale, run.agent.obs_scale) == (5.0, 0.5)
    assert run.env.name == "Pendulum-v1"


def test_environments_in_the_configs_are_registered_or_need_a_package() -> None:
    register_all()
    for path in sorted((CONF / "env").glob("*.yaml")):
        env_id = str(OmegaConf.to_container(OmegaConf.load(path), resolve=False)["id"])  # type: ignore[index,call-overload]
        if env_id.startswith("rpg/"):
            assert env_id in gymnasium.registry, path.name


@pytest.mark.parametrize("env", ["maze", "gymnasium", "bandit"])
@pytest.mark.parametrize("agent", [name for name in AGENTS if name not in GOALS])
def test_every_agent_runs_the_debug_preset(composed: Composed, tmp_path: Path, agent: str, env: str) -> None:
    quick = ["trainer.steps=60", "trainer.seed_decisions=40", "trainer.picture_every=0"]
    quick += ["trainer.eval_episodes=1", "trainer.eval_envs=1", "size.rnd_batch_size=16"]
    if (agent, env) == ("bump", "bandit"):
        quick.append("+agent.position=1")  # it looks at two entries otherwise; here there is one
    row = train(composed("experiment=debug", f"agent={agent}", f"env={env}", *quick))
    assert row["env_steps"] == 60
    assert row["eval/deterministic/length"] == {"maze": 50, "gymnasium": 200, "bandit": 1}[env]
    assert (row["updates"] > 0) == (agent in LEARNERS) == ("loss/rnd" in row)
    assert LEARNERS.get(agent, "updates") in row
    assert ("loss/posterior" in row) == (agent == "rpg")
    assert (tmp_path / "run" / "checkpoint.pt").exists()


@pytest.mark.parametrize("agent", sorted(LEARNERS))
def test_every_learner_runs_without_and_with_the_other_bonus(composed: Composed, agent: str) -> None:
    quick = [
        "trainer.steps=60",
        "trainer.seed_decisions=40",
        "trainer.picture_every=0",
        "trainer.eval_every=0",
    ]
    row = train(composed("experiment=debug", f"agent={agent}", "exploration=plan2explore", *quick))
    assert row["updates"] > 0
    assert row["loss/ensemble"] > 0
    assert row["train/disagreement"] > 0
    other = composed("experiment=debug", f"agent={agent}", "exploration=none", *quick)
    other.run_dir += "_none"
    bare = train(other)
    assert LEARNERS[agent] in bare
    assert {"loss/ensemble", "loss/rnd"}.isdisjoint(bare)


@pytest.mark.parametrize(
    ("env", "task"),
    [("gymnasium", "Hopper-v5"), ("gymnasium_robotics", "FetchPush-v4"), ("metaworld", "door-open-v3"),
     ("maniskill", "PushCube-v1")],
)  # fmt: skip
def test_adapters_take_their_task_at_the_top_of_the_config(composed: Composed, env: str, task: str) -> None:
    config = parse_config(composed(f"env={env}", f"id={task}")).env
    assert config.name == task
    assert task in (config.id, config.kwargs.get("task"))
