"""SAPIEN scenes of collision shapes alone: no renderer, no graphics driver."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
from sapien import physx

VULKAN_REMEDY = "install a graphics driver, on a CPU Mesa's lavapipe 24.3 or newer with libvulkan1"


@contextmanager
def physx_settings(
    *,
    gravity: tuple[float, float, float],
    contact_offset: float,
    position_iterations: int,
    velocity_iterations: int,
    persistent_contacts: bool,
    friction: float,
) -> Iterator[None]:
    """PhysX defaults for whatever is built inside, put back on leaving.

    PhysX keeps these per process, so a scene that relied on them would change with what was built before it.

    Args:
        gravity: m/s^2, world frame.
        contact_offset: distance in m below which contacts are made.
        position_iterations: of the solver, per sub-step.
        velocity_iterations: of the solver, per sub-step.
        persistent_contacts: keep contact manifolds from one sub-step to the next ("PCM").
        friction: of surfaces that are given no material.
    """
    scene, body, shape = (
        {key: getattr(config, key) for key in dir(config) if not key.startswith("_")}
        for config in (physx.get_scene_config(), physx.get_body_config(), physx.get_shape_config())
    )
    material = physx.get_default_material()
    surface = material.static_friction, material.dynamic_friction, material.restitution
    physx.set_scene_config(gravity=np.asarray(gravity, dtype=np.float32), enable_pcm=persistent_contacts)
    physx.set_body_config(
        solver_position_iterations=position_iterations,
        solver_velocity_iterations=velocity_iterations,
        sleep_threshold=0.0,
    )
    physx.set_shape_config(contact_offset=contact_offset, rest_offset=0.0)
    physx.set_default_material(friction, friction, 0.0)
    try:
        yield
    finally:
        physx.set_scene_config(**scene)
        physx.set_body_config(**body)
        physx.set_shape_config(**shape)
        physx.set_default_material(*surface)


def physics_scene(timestep: float, *systems: Any) -> Any:
    """An empty scene that simulates ``timestep`` seconds per sub-step, and does what more ``systems`` do."""
    scene = sapien.Scene([physx.PhysxCpuSystem(), *systems])
    scene.timestep = timestep
    return scene


def vulkan_missing() -> str | None:
    """Why SAPIEN can draw no picture here and what to do, in one line; None if it can."""
    try:
        sapien.render.RenderSystem()
    except RuntimeError as error:
        return f"a picture needs a Vulkan device and SAPIEN found none ({error}); {VULKAN_REMEDY}"
    return None
