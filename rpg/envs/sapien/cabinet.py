"""Open the doors of a cabinet with a mobile Panda (Cabinet dense and sparse, thesis Sec. 3.5.2), on SAPIEN alone."""

from __future__ import annotations

import math
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import sapien
from gymnasium.spaces import Box
from numpy.typing import NDArray

from rpg.envs.checks import checked_action, checked_render_mode
from rpg.envs.sapien import cabinet_model as model
from rpg.envs.sapien.cabinet_task import (
    CabinetStart,
    CabinetState,
    checked_variant,
    draw_start,
    evaluate,
    observation,
    reward,
)
from rpg.envs.sapien.physics import physics_scene, physx_settings, vulkan_missing
from rpg.errors import RPGError

Floats = NDArray[np.float32]
Frame = NDArray[np.uint8]

BASE, ARM = len(model.BASE_JOINTS), len(model.ARM_JOINTS)


class CabinetPhysics:
    """Robot and cabinet in a scene of their own.

    Args:
        mobile: the robot drives; otherwise its base is fixed.
        sim_freq: sub-steps per second, a multiple of the 20 decisions per second.
        visuals: build what a camera sees as well; needs a graphics driver.
    """

    def __init__(self, mobile: bool, sim_freq: int, visuals: bool = False) -> None:
        self.mobile = mobile
        self._sim_freq, self._visuals = sim_freq, visuals
        self._substeps = sim_freq // model.CONTROL_FREQ
        self._base = BASE if mobile else 0
        self.scene = self._empty_scene()
        self._builders = [self._robot_builder(), self._cabinet_builder()]
        self._fill_scene()

    def _empty_scene(self) -> Any:
        with self._settings():
            systems = (sapien.render.RenderSystem(),) if self._visuals else ()
            return physics_scene(1.0 / self._sim_freq, *systems)

    def _settings(self) -> AbstractContextManager[None]:
        return physx_settings(
            gravity=(0.0, 0.0, -9.81),
            contact_offset=model.CONTACT_OFFSET,
            position_iterations=model.POSITION_ITERATIONS,
            velocity_iterations=model.VELOCITY_ITERATIONS,
            persistent_contacts=True,
            friction=model.OTHER_FRICTION,
        )

    def _fill_scene(self) -> None:
        with self._settings():
            self._add_ground()
            self.robot, self.cabinet = (
                builder.set_scene(self.scene).build(fix_root_link=True) for builder in self._builders
            )
        for link in self.robot.links:
            link.disable_gravity = True  # the real arm's controller carries its weight
        links = {link.name: link for link in self.robot.links}
        self._fingers = [links[name] for name in model.FINGER_LINKS]
        self._joints = self.robot.active_joints
        self._doors = self.cabinet.active_joints
        drives = [model.BASE_DRIVE] * self._base + [model.ARM_DRIVE] * ARM + [model.FINGER_DRIVE] * 2
        for joint, drive in zip(self._joints, drives, strict=True):
            joint.set_drive_properties(drive.stiffness, drive.damping, drive.force_limit, "force")
            joint.set_friction(0.0)

    def reset(self, start: CabinetStart) -> None:
        """Doors closed, robot at its start, all at rest.

        The scene is built anew, in a millisecond or two: PhysX keeps data of past contacts that cannot be
        cleared, and with it equal episodes would differ after the first touch.
        """
        self.scene.clear()
        self.scene = self._empty_scene()
        self._fill_scene()
        for joint, friction, damping in zip(self._doors, start.friction, start.damping, strict=True):
            joint.set_friction(friction)
            joint.set_drive_properties(0.0, damping)
        base = (*start.base, model.START_LIFT) if self.mobile else ()
        qpos = (*base, *model.START_ARM, model.START_FINGER, model.START_FINGER)
        self.robot.set_qpos(np.array(qpos, dtype=np.float32))
        self.robot.set_qvel(np.zeros(len(qpos), dtype=np.float32))
        self.cabinet.set_qpos(np.zeros(2, dtype=np.float32))
        self.cabinet.set_qvel(np.zeros(2, dtype=np.float32))
        for joint in self._joints[:-2]:
            joint.set_drive_velocity_target(0.0)
        for joint in self._joints[-2:]:
            joint.set_drive_target(model.START_FINGER)

    def step(self, action: NDArray[Any]) -> None:
        """One control step of 0.05 s.

        Args:
            action: (12,) in [-1, 1]: base forward, left, yaw and lift velocity, 7 arm joint velocities,
                gripper opening; or (8,) without the first four where the base is fixed.
        """
        velocity = action[:-1] * self._speed
        if self.mobile:
            yaw = float(self.robot.qpos[2])
            cos, sin = math.cos(yaw), math.sin(yaw)
            forward, left = velocity[0], velocity[1]
            velocity[0], velocity[1] = cos * forward - sin * left, sin * forward + cos * left
        for joint, target in zip(self._joints, velocity, strict=False):
            joint.set_drive_velocity_target(float(target))
        low, high = model.FINGER_DRIVE.lower[0], model.FINGER_DRIVE.upper[0]
        opening = low + (float(action[-1]) + 1) / 2 * (high - low)
        for joint in self._joints[-2:]:
            joint.set_drive_target(opening)
        for _ in range(self._substeps):
            self.scene.physx_system.step()

    def state(self) -> CabinetState:
        """The present state, float32, without a batch dimension."""
        poses = [finger.entity_pose for finger in self._fingers]
        return CabinetState(
            self.robot.qpos,
            self.robot.qvel,
            np.stack([pose.p for pose in poses]),
            np.stack([pose.q for pose in poses]),
            np.stack([finger.linear_velocity for finger in self._fingers]),
            self.cabinet.qpos,
            self.cabinet.qvel,
        )

    def close(self) -> None:
        """Free the scene."""
        self.scene.clear()

    @property
    def _speed(self) -> NDArray[np.float64]:
        return _SPEED if self.mobile else _SPEED[BASE:]

    def _robot_builder(self) -> Any:
        loader = self.scene.create_urdf_loader()
        model.prepare_robot(loader)
        with self._settings(), tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(model.robot_urdf(self.mobile, self._visuals))
            builder = loader.parse(str(path))[0][0]
        model.filter_robot_collisions(builder)
        return builder

    def _cabinet_builder(self) -> Any:
        builder = self.scene.create_articulation_builder()
        model.add_cabinet(builder, self._visuals)
        return builder

    def _add_ground(self) -> None:
        builder = self.scene.create_actor_builder()
        builder.collision_groups[model.IGNORE_GROUP] |= 1 << model.GROUND_BIT
        up = sapien.Pose(q=model.Z_FROM_X.q)
        builder.add_plane_collision(up)
        if self._visuals:
            builder.add_plane_visual(up, (10.0, 10.0, 10.0), material=model.paint((0.55, 0.57, 0.60)))
        builder.build_static(name="ground")


_SPEED = np.array([*model.BASE_DRIVE.upper, *model.ARM_DRIVE.upper])


class CabinetPicture:
    """A camera on a copy of the scene that is built for show, so that the simulated one needs no renderer.

    Args:
        mobile: as in :class:`CabinetPhysics`.
        size: height and width, pixels.

    Raises:
        RPGError: no graphics driver that SAPIEN can use.
    """

    def __init__(self, mobile: bool, size: int) -> None:
        if missing := vulkan_missing():
            raise RPGError(f"cabinet: {missing}, or set render_mode=None")
        self._copy = CabinetPhysics(mobile, model.CONTROL_FREQ, visuals=True)
        scene = self._copy.scene
        scene.set_ambient_light([0.4, 0.4, 0.4])
        scene.add_directional_light([0.6, -0.5, -1.0], [1.0, 1.0, 1.0])
        self._camera = scene.add_camera("picture", size, size, model.CAMERA_FOV, 0.05, 20.0)
        eye = np.array(model.CAMERA_EYE)
        ahead = np.array(model.CAMERA_TARGET) - eye
        pose = np.eye(4)
        pose[:3, 0] = ahead / np.linalg.norm(ahead)
        left = np.cross([0.0, 0.0, 1.0], pose[:3, 0])
        pose[:3, 1] = left / np.linalg.norm(left)
        pose[:3, 2] = np.cross(pose[:3, 0], pose[:3, 1])
        pose[:3, 3] = eye
        self._camera.entity.set_pose(sapien.Pose(pose))

    def frame(self, physics: CabinetPhysics) -> Frame:
        """uint8 (size, size, 3) of the present state of ``physics``."""
        self._copy.robot.set_qpos(physics.robot.qpos)
        self._copy.cabinet.set_qpos(physics.cabinet.qpos)
        self._copy.scene.update_render()
        self._camera.take_picture()
        colours = self._camera.get_picture("Color")[..., :3]
        return (colours.clip(0.0, 1.0) * 255 + 0.5).astype(np.uint8)

    def close(self) -> None:
        """Free the scene."""
        self._copy.close()


class CabinetEnv(gymnasium.Env[Floats, Floats]):
    """A two-door kitchen cabinet in front of a Panda arm; see ``docs/envs/cabinet.md``.

    ``dense``: the robot drives; observation (78,), action (12,). Reward: share of the way to the 90 % mark of
    both doors, 2 more while door 0 is open and 1 while door 1 is, less twice the distance of the fingers from
    the nearer handle. Success: door 0 open.

    ``sparse``: the base is fixed; observation (80,), action (8,). Reward 1 while both doors are beyond 72 %
    of their range; success the same.

    Args:
        variant: "dense" or "sparse".
        published_actions: sparse only: 12 actions of which the first four do nothing.
        sim_freq: sub-steps per second, a multiple of 20.
        render_mode: "rgb_array" or None; pictures need a graphics driver, nothing else does.
        picture_size: side of rendered frames, pixels.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": model.CONTROL_FREQ}  # noqa: RUF012
    action_repeat = 1

    def __init__(
        self,
        variant: str = "dense",
        published_actions: bool = False,
        sim_freq: int = model.SIM_FREQ,
        render_mode: str | None = None,
        picture_size: int = 256,
    ) -> None:
        task = checked_variant(variant)
        self.name = f"cabinet ({variant})"
        if sim_freq < model.CONTROL_FREQ or sim_freq % model.CONTROL_FREQ:
            raise RPGError(f"{self.name}: sim_freq={sim_freq} must be a multiple of {model.CONTROL_FREQ}")
        self.variant = variant
        self.render_mode = checked_render_mode(self.name, render_mode)
        self.physics = CabinetPhysics(task.mobile, sim_freq)
        self._ignored = BASE if published_actions and not task.mobile else 0
        self._action_size = (BASE if task.mobile else 0) + ARM + 1 + self._ignored
        self.observation_space = Box(-np.inf, np.inf, (task.obs_size,), np.float32)
        self.action_space = Box(-1.0, 1.0, (self._action_size,), np.float32)
        self.objects_of_interest = task.objects
        self._picture_size = picture_size
        self._picture: CabinetPicture | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Closed doors, a new place of the mobile base, new friction and damping of the doors."""
        super().reset(seed=seed)
        self.physics.reset(draw_start(self.np_random))
        state = self.physics.state()
        return observation(state, self.variant), self._info(state)

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """One decision, 0.05 s; see :meth:`CabinetPhysics.step`.

        Raises:
            RPGError: the action has another shape.
            NonFiniteError: the action is NaN or infinite.
        """
        command = checked_action(self.name, action, self._action_size)
        self.physics.step(command[self._ignored :])
        state = self.physics.state()
        value = float(reward(state, self.variant))
        return observation(state, self.variant), value, False, False, self._info(state)

    def render(self) -> Frame | None:
        """The scene from the robot's left, uint8 (size, size, 3), or None without a render mode.

        Raises:
            RPGError: no graphics driver.
        """
        if self.render_mode is None:
            return None
        if self._picture is None:
            self._picture = CabinetPicture(self.physics.mobile, self._picture_size)
        return self._picture.frame(self.physics)

    def close(self) -> None:
        """Free physics and renderer."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None
        self.physics.close()

    def _info(self, state: CabinetState) -> dict[str, Any]:
        return {key: bool(value) for key, value in evaluate(state, self.variant).items()}
