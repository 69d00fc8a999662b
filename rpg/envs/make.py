"""Making vectorised environments by name."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, VectorEnv

from rpg.envs.config import EnvConfig
from rpg.envs.registration import register_all
from rpg.errors import RPGError, nearest
from rpg.exploration.objects import ObjectsOfInterest


def make_envs(config: EnvConfig, num_envs: int | None = None) -> VectorEnv[Any, Any, Any]:
    """Make a batch in ``AutoresetMode.DISABLED``; batched environments are used where one is registered.

    Raises:
        RPGError: no such environment, a missing package, or arguments that it does not take.
    """
    register_all()
    num_envs = num_envs or config.num_envs
    try:
        spec = gym.spec(config.id)
        if spec.vector_entry_point is not None:
            return gym.make_vec(
                spec, num_envs=num_envs, vectorization_mode="vector_entry_point", **config.kwargs
            )
        return gym.make_vec(
            spec,
            num_envs=num_envs,
            vectorization_mode="async" if config.asynchronous else "sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
            **config.kwargs,
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
        raise RPGError(
            f"environment '{config.id}': env.kwargs={config.kwargs} do not fit: {error}"
        ) from error


def declared_objects(envs: VectorEnv[Any, Any, Any]) -> ObjectsOfInterest | None:
    """Objects of interest that the environment declares, if it does."""
    own = getattr(envs, "objects_of_interest", None)
    if own is None and hasattr(envs, "get_attr"):
        try:
            own = envs.get_attr("objects_of_interest")[0]
        except AttributeError:
            return None
    return own if isinstance(own, ObjectsOfInterest) else None
