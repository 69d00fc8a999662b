"""One environment out of a batched one, for gymnasium's single-environment tools."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

Array = NDArray[Any]


class SingleEnv(gymnasium.Env[Array, Array]):
    """A batch of one, without the batch dimension.

    Args:
        batch: a vector environment with ``num_envs=1`` that offers ``get_state`` and ``set_state``.
        render_mode: as given to the batch.
    """

    def __init__(self, batch: VectorEnv[Array, Array, Array], render_mode: str | None = None) -> None:
        self._batch: Any = batch
        self.render_mode = render_mode
        self.observation_space = batch.single_observation_space
        self.action_space = batch.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start the next episode; options as the batch takes them, without its dimension."""
        super().reset(seed=seed)
        observations, info = self._batch.reset(
            seed=None if seed is None else [seed],
            options=None if options is None else {key: [value] for key, value in options.items()},
        )
        return observations[0], info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """The batch's step, for one action (action_dim,)."""
        observations, reward, terminated, truncated, info = self._batch.step(np.asarray(action)[None])
        single_info = {key: value[0] for key, value in info.items()}
        return observations[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), single_info

    def get_state(self) -> dict[str, Any]:
        """The batch's state, arrays with one row."""
        state: dict[str, Any] = self._batch.get_state()
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue, bit-equal, from :meth:`get_state`."""
        self._batch.set_state(state)
