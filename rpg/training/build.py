"""From Hydra's plain config to a trainer: validate, then assemble."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from rpg.agents import Agent, RPGConfig
from rpg.agents.learners import LEARNERS
from rpg.agents.scripted import SCRIPTED, make_scripted
from rpg.allocation import keep_freed_memory
from rpg.compiling import compiler_missing
from rpg.conf import compose_config
from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs, objects_of_interest
from rpg.errors import CheckpointError, RPGError, nearest
from rpg.exploration import (
    ExplorationBonus,
    ObjectsOfInterest,
    Plan2Explore,
    Plan2ExploreConfig,
    RandomNetworkDistillation,
    RNDConfig,
)
from rpg.goals import goal_spec_of
from rpg.landmarks.config import PlannerConfig
from rpg.pixels import FrameShape
from rpg.training.checkpoint import load_checkpoint
from rpg.training.config import LoggerConfig, RunConfig, TrainerConfig
from rpg.training.loggers import Loggers, Sink, TensorBoardSink, WandbSink
from rpg.training.trainer import Trainer
from rpg.training.video import check_pictures

EXPLORATIONS: dict[str, type[Any]] = {
    "none": RNDConfig,  # which nobody reads
    "rnd": RNDConfig,
    "plan2explore": Plan2ExploreConfig,
}
"""Settings of the exploration bonuses by name."""

PLANNERS = ("none", "landmarks")
"""The planners of goal-conditioned agents by name."""


def env_preset(name: str) -> EnvConfig:
    """The section ``env`` of the config under ``env=<name>``.

    Raises:
        RPGError: no such preset, or one that does not fit.
    """
    return parse_config(compose_config(f"env={name}", "device=cpu", "run_dir=unused")).env


def parse_config(cfg: DictConfig) -> RunConfig:
    """Check every section against its dataclass.

    Raises:
        RPGError: an unknown key, a wrong type or an impossible value, in one line.
    """
    plain = _plain(cfg)
    for section in ("agent", "world_model", "exploration", "env", "trainer", "logger"):
        if not isinstance(plain.get(section), dict):
            raise RPGError(f"config: section '{section}' is {plain.get(section)!r}, but a run needs it")
    for key in ("device", "run_dir"):
        if not isinstance(plain.get(key), str):
            raise RPGError(f"{key}={plain.get(key)!r}: must be a text")
    agent = dict(plain["agent"])
    name = agent.pop("name", None)
    if name not in (*LEARNERS, *SCRIPTED):
        raise RPGError(f"agent.name={name!r}: unknown agent; {nearest(str(name), (*LEARNERS, *SCRIPTED))}")
    learner = LEARNERS.get(name)
    exploration = dict(plain["exploration"])
    exploration_name = exploration.pop("name", None)
    if exploration_name not in EXPLORATIONS:
        raise RPGError(f"exploration.name={exploration_name!r}: choose {', '.join(EXPLORATIONS)}")
    planner = dict(plain.get("planner") or {"name": "none"})
    planner_name = planner.pop("name", None)
    if planner_name not in PLANNERS:
        raise RPGError(f"planner.name={planner_name!r}: choose {', '.join(PLANNERS)}")
    threads = plain.get("threads")
    if threads is not None and (not isinstance(threads, int) or threads < 1):
        raise RPGError(f"threads={threads!r}: a whole number of at least 1, or null")
    if not isinstance(plain.get("seed"), int) or plain["seed"] < 0:
        raise RPGError(f"seed={plain.get('seed')!r}: must be a whole number, not negative")
    return RunConfig(
        agent_name=name,
        agent=_section(learner.config, learner.settings(agent, plain["world_model"]), "agent")
        if learner
        else RPGConfig(),
        agent_options={} if learner else agent,
        exploration_name=exploration_name if learner else "none",
        exploration=_section(EXPLORATIONS[exploration_name], exploration, "exploration"),
        planner=None if planner_name == "none" else _section(PlannerConfig, planner, "planner"),
        env=_section(EnvConfig, plain["env"], "env"),
        trainer=_section(TrainerConfig, plain["trainer"], "trainer"),
        logger=_section(LoggerConfig, plain["logger"], "logger"),
        seed=plain["seed"],
        device=(device := _device(plain["device"])),
        compile=_compile(plain.get("compile"), device) and learner is not None,
        threads=threads,
        run_dir=plain["run_dir"],
        plain=plain,
    )


def _plain(cfg: DictConfig) -> dict[str, Any]:
    try:
        plain = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise RPGError(f"config: {_first_line(error)}; give it on the command line") from error
    except OmegaConfBaseException as error:
        raise RPGError(f"config: {_first_line(error)}") from error
    assert isinstance(plain, dict)
    return {str(k): v for k, v in plain.items()}


def _section(schema: type[Any], values: dict[str, Any], where: str) -> Any:
    try:
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), values))
    except ConfigKeyError as error:
        key = str(error.full_key or error.key)
        parent: Any = OmegaConf.select(OmegaConf.structured(schema), ".".join(key.split(".")[:-1]) or "")
        known = [str(k) for k in (parent if parent is not None else OmegaConf.structured(schema))]
        raise RPGError(f"{where}.{key}: unknown key; {nearest(key.split('.')[-1], known)}") from error
    except OmegaConfBaseException as error:
        raise RPGError(f"{where}.{error.full_key}: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0]


def _device(name: str) -> str:
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise RPGError(f"device={name!r}: choose auto, cpu or cuda") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise RPGError(f"device={name!r}: no usable GPU here; choose device=cpu or auto")
    return name


def _compile(wanted: Any, device: str) -> bool:
    if wanted not in ("auto", True, False):
        raise RPGError(f"compile={wanted!r}: choose auto, true or false")
    missing = compiler_missing(torch.device(device)) if wanted else None
    if wanted is True and missing:
        raise RPGError(f"compile=true: {missing}; install one, or take compile=auto or false")
    return bool(wanted) and not missing


def build_agent(run: RunConfig, envs: Any) -> tuple[Agent, ObjectsOfInterest]:
    """Make the agent for these environments, and the objects of interest it was told of."""
    obs_space, action_space = envs.single_observation_space, envs.single_action_space
    frames = FrameShape.of(obs_space, run.env.frame_stack)
    if frames is not None:
        obs_space = frames.space
    if run.agent_name in SCRIPTED:
        agent: Agent = make_scripted(run.agent_name, obs_space, action_space, run.device, **run.agent_options)
        return agent, ObjectsOfInterest.of(())
    learner = LEARNERS[run.agent_name]
    if learner.goals:
        spec = goal_spec_of(envs)
        agent = learner.build(obs_space, action_space, spec, run.agent, run.planner, run.device)
        return agent, ObjectsOfInterest.of(())
    if run.planner is not None:
        raise RPGError(f"planner=landmarks: agent={run.agent_name} has no goals; choose ddpg_her or dqn_her")
    Agent(obs_space, action_space)  # spaces are checked before their shape is used
    objects = ObjectsOfInterest.of(()) if frames else objects_of_interest(run.env, envs, obs_space.shape[0])
    return learner.build(obs_space, action_space, run.agent, objects, run.device), objects


def build_exploration(run: RunConfig, agent: Agent, objects: ObjectsOfInterest) -> ExplorationBonus | None:
    """Make the bonus that the run asks for, if any."""
    if run.exploration_name == "none":
        return None
    if agent.hindsight is not None:
        raise RPGError(
            f"exploration={run.exploration_name}: the value of agent={run.agent_name} is a distance, to which no "
            "bonus can be added; choose exploration=none"
        )
    if isinstance(run.exploration, Plan2ExploreConfig):
        return Plan2Explore(agent, run.exploration)
    return RandomNetworkDistillation(agent.frames or objects, run.exploration, run.device)


def build_trainer(run: RunConfig) -> Trainer:
    """Make everything a run needs. Seeds torch and sets its thread count.

    Raises:
        RPGError: a bad setting, a missing package, or a run folder that cannot be written.
    """
    film_envs = partial(make_envs, run.env.for_evaluation(), 1, render=True)
    if run.trainer.video_every:
        check_pictures(film_envs, run.seed, run.env.name)
    if run.threads is not None:
        torch.set_num_threads(run.threads)
    # Saturated networks make numbers so small that a CPU computes with them many times slower.
    torch.set_flush_denormal(True)
    keep_freed_memory()
    torch.manual_seed(run.seed)
    np.random.seed(run.seed)  # some gymnasium environments draw from numpy's global generator
    envs = make_envs(run.env)
    agent, objects = build_agent(run, envs)
    run_dir = Path(run.run_dir)
    trainer = Trainer(
        agent=agent,
        exploration=build_exploration(run, agent, objects),
        envs=envs,
        eval_envs=lambda: make_envs(run.env.for_evaluation(), run.trainer.eval_envs),
        config=run.trainer,
        run_dir=run_dir,
        loggers=Loggers(run_dir, _sinks(run, run_dir)),
        seed=run.seed,
        plain_config=run.plain,
        env_name=run.env.name,
        action_repeat=run.env.action_repeat,
        film_envs=film_envs,
    )
    if run.compile:
        trainer.compile()
    return trainer


def _sinks(run: RunConfig, run_dir: Path) -> list[Sink]:
    sinks: list[Sink] = []
    if run.logger.tensorboard:
        sinks.append(TensorBoardSink(run_dir))
    if run.logger.wandb:
        sinks.append(WandbSink(run_dir, run.logger.wandb_project, run.plain))
    return sinks


# Settings that may change between restarts without making it another run.
_FREE = (
    "trainer.steps", "trainer.stop_at_success", "trainer.checkpoint_every", "device", "compile", "threads",
    "run_dir", "logger", "budget", "whole",
)  # fmt: skip


def require_same_run(path: Path, run: RunConfig) -> dict[str, Any]:
    """Load ``path`` and make sure that it belongs to ``run``.

    Raises:
        CheckpointError: unreadable, or made by another configuration; names the first difference.
    """
    state = load_checkpoint(path)
    stored, wanted = _flatten(state["config"]), _flatten(run.plain)
    for key in sorted(stored.keys() | wanted.keys()):
        if key.startswith(_FREE):
            continue
        if stored.get(key) != wanted.get(key):
            raise CheckpointError(
                f"run folder {path.parent}: holds a run with {key}={stored.get(key)}, asked for "
                f"{wanted.get(key)}; choose another run_dir or the same settings"
            )
    return state


def _flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict):
        return {prefix[:-1]: tree}
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= _flatten(value, f"{prefix}{key}.")
    return flat
