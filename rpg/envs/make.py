"""Making vectorised environments by name."""

from __future__ import annotations

import importlib
import multiprocessing
import signal
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, VectorEnv

from rpg.attributes import declared
from rpg.envs.config import EnvConfig
from rpg.envs.goals import FlatGoals
from rpg.envs.headless import prefer_offscreen_gl
from rpg.envs.registration import register_all
from rpg.envs.repeat import ActionRepeat
from rpg.errors import RPGError, nearest
from rpg.exploration.objects import ObjectsOfInterest


def make_envs(
    config: EnvConfig, num_envs: int | None = None, render: bool = False
) -> VectorEnv[Any, Any, Any]:
    """Make a batch in ``AutoresetMode.DISABLED``; batched environments are used where one is registered.

    Args:
        config: which, and how.
        num_envs: instead of ``config.num_envs``.
        render: whether :meth:`render` is to give RGB pictures; opens no renderer otherwise. All in this process.

    Raises:
        RPGError: no such environment, a missing package, or arguments that it does not take.
    """
    register_all()
    prefer_offscreen_gl()
    num_envs = num_envs or config.num_envs
    apart = config.asynchronous and not render
    kwargs = config.kwargs | ({"render_mode": "rgb_array"} if render else {})
    try:
        if config.module is not None:
            importlib.import_module(config.module)
        spec = gym.spec(config.id)
        if spec.vector_entry_point is not None:
            return gym.make_vec(spec, num_envs=num_envs, vectorization_mode="vector_entry_point", **kwargs)
        return gym.make_vec(
            spec,
            num_envs=num_envs,
            vectorization_mode="async" if apart else "sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED}
            | ({"context": _worker_start()} if apart else {}),
            wrappers=[partial(_adapted, repeat=config.action_repeat)],  # type: ignore[list-item]  # or none
            **kwargs,
        )
    except gym.error.DependencyNotInstalled as error:
        raise RPGError(f"environment '{config.id}': {' '.join(str(error).split())}") from error
    except gym.error.Error as error:
        raise RPGError(
            f"env.id='{config.id}': unknown environment; {nearest(config.id, gym.registry)}"
        ) from error
    except ImportError as error:
        raise RPGError(
            f"environment '{config.id}': its package is not installed ({error}); pip install {error.name}"
        ) from error
    except TypeError as error:
        if "'render_mode'" in str(error):
            raise RPGError(
                f"environment '{config.id}': draws no pictures; leave videos off (trainer.video_every=0)"
            ) from error
        raise RPGError(
            f"environment '{config.id}': env.kwargs={config.kwargs} do not fit: {error}"
        ) from error


def _worker_start() -> str:
    """How worker processes begin: from one without threads, locks or graphics of this one.

    A plain fork copies locks that threads of torch or of a renderer hold, and would wait for them for ever.
    """
    multiprocessing.set_forkserver_preload(["rpg.envs.make"])
    return "forkserver"


def _adapted(env: gym.Env[Any, Any], repeat: int) -> gym.Env[Any, Any]:
    """What any environment gets: goals in one vector with its observation, and repeated actions."""
    if multiprocessing.parent_process() is not None:
        signal.signal(
            signal.SIGINT, signal.SIG_IGN
        )  # Ctrl-C is for the trainer, which saves and ends workers
    if isinstance(env.observation_space, gym.spaces.Dict):
        env = FlatGoals(env)
    own = getattr(env.unwrapped, "action_repeat", None)
    if own is None:
        return env if repeat == 1 else ActionRepeat(env, repeat)
    if own != repeat:
        raise RPGError(
            f"env.action_repeat={repeat}, but the environment repeats every action {own} times; "
            f"set env.action_repeat={own}, or both if env.kwargs.action_repeat is taken"
        )
    return env


def objects_of_interest(config: EnvConfig, envs: VectorEnv[Any, Any, Any], obs_dim: int) -> ObjectsOfInterest:
    """Those of the config, else those that the environment declares, else the whole observation.

    Raises:
        RPGError: an entry that the observation does not have, or scales that do not fit.
    """
    if config.objects is None:
        own = declared(envs, "objects_of_interest")
        return own if isinstance(own, ObjectsOfInterest) else ObjectsOfInterest.everything(obs_dim)
    unknown = sorted(config.objects.keys() - {"index", "scale", "offset"})
    index = config.objects.get("index")
    if unknown or not isinstance(index, list) or not all(type(i) is int for i in index):
        raise RPGError(
            f"env.objects={config.objects}: give index, a list of entries, and maybe scale and offset"
        )
    outside = [i for i in index if not 0 <= i < obs_dim]
    if outside or not index:
        raise RPGError(
            f"env.objects.index={index}: the observation of '{config.id}' has the entries 0 to {obs_dim - 1}"
        )
    return ObjectsOfInterest.of(index, config.objects.get("scale", 1.0), config.objects.get("offset", 0.0))
