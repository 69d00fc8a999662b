"""The cabinet tasks as ManiSkill tasks ``rpg-CabinetDense-v1`` and ``rpg-CabinetSparse-v1``, for CPU and GPU batches.

Importing this module registers robots and tasks with ManiSkill. Bodies come from
:mod:`rpg.envs.sapien.cabinet_model`, formulas from :mod:`rpg.envs.sapien.cabinet_task`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import (
    PDBaseVelControllerConfig,
    PDJointPosMimicControllerConfig,
    PDJointVelControllerConfig,
    deepcopy_dict,
)
from mani_skill.agents.registration import register_agent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose
from mani_skill.utils.structs.types import DefaultMaterialsConfig, SceneConfig, SimConfig
from torch import Tensor

from rpg.envs.sapien import cabinet_model as model
from rpg.envs.sapien.cabinet_task import VARIANTS, CabinetState, draw_start, evaluate, observation, reward

HORIZON = 60
ASIDE = sapien.Pose([-4.0, 0.0, 0.0])  # where the robot is built, clear of the cabinet
BEST_DENSE = 5.0  # both doors open, a finger on a handle


@register_agent()
class MobilePanda(BaseAgent):
    """Panda arm on a lift on a base that drives in the plane; 12 actions in the mode ``pd_joint_vel``."""

    uid = "rpg_mobile_panda"
    mobile = True
    keyframes = {  # noqa: RUF012 (as ManiSkill declares it)
        "start": Keyframe(
            pose=sapien.Pose(),
            qpos=np.array([-1.7, 0.5, 0.0, model.START_LIFT, *model.START_ARM, *(model.START_FINGER,) * 2]),
        )
    }

    def _load_articulation(self, initial_pose: Any = None) -> None:
        loader = self.scene.create_urdf_loader()
        loader.name = self.uid
        model.prepare_robot(loader)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(model.robot_urdf(self.mobile, visuals=self.scene.can_render()))
            builder = loader.parse(str(path))["articulation_builders"][0]
        model.filter_robot_collisions(builder)
        builder.initial_pose = sapien.Pose() if initial_pose is None else initial_pose
        self.robot = builder.build(fix_root_link=True)
        self.robot_link_names = [link.name for link in self.robot.get_links()]

    @property
    def _controller_configs(self) -> dict[str, Any]:
        base, arm, finger = model.BASE_DRIVE, model.ARM_DRIVE, model.FINGER_DRIVE
        parts: dict[str, Any] = {}
        if self.mobile:
            parts["base"] = PDBaseVelControllerConfig(
                list(model.BASE_JOINTS), base.lower, base.upper, base.damping, base.force_limit
            )
        parts["arm"] = PDJointVelControllerConfig(
            list(model.ARM_JOINTS), arm.lower, arm.upper, arm.damping, arm.force_limit
        )
        first, second = model.FINGER_JOINTS
        parts["gripper"] = PDJointPosMimicControllerConfig(
            [first, second],
            finger.lower[0],
            finger.upper[0],
            finger.stiffness,
            finger.damping,
            finger.force_limit,
            mimic={second: {"joint": first}},
        )
        return deepcopy_dict({"pd_joint_vel": parts})


@register_agent()
class FixedPanda(MobilePanda):
    """The same robot with its base and lift fixed at the start of the sparse task; 8 actions."""

    uid = "rpg_fixed_panda"
    mobile = False
    keyframes = {  # noqa: RUF012 (as ManiSkill declares it)
        "start": Keyframe(
            pose=sapien.Pose(), qpos=np.array([*model.START_ARM, model.START_FINGER, model.START_FINGER])
        )
    }


class CabinetTask(BaseEnv):
    """Two doors to open; see ``docs/envs/cabinet.md``. Never terminates.

    Friction and damping of the doors are drawn at each reset on the CPU. PhysX on the GPU does not take them
    after its start, so there each sub-scene keeps those it was built with.
    """

    variant: str
    agent: MobilePanda

    def __init__(self, *args: Any, robot_uids: str, **kwargs: Any) -> None:
        self.objects_of_interest = VARIANTS[self.variant].objects
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        friction = model.OTHER_FRICTION
        return SimConfig(
            spacing=10.0,  # sub-scenes share a world on the GPU, and the robot drives
            sim_freq=model.SIM_FREQ,
            control_freq=model.CONTROL_FREQ,
            scene_config=SceneConfig(
                contact_offset=model.CONTACT_OFFSET,
                solver_position_iterations=model.POSITION_ITERATIONS,
                solver_velocity_iterations=model.VELOCITY_ITERATIONS,
                sleep_threshold=0.0,
            ),
            default_materials_config=DefaultMaterialsConfig(friction, friction, 0.0),
        )

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return [self._camera("base_camera", 128)]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        return self._camera("render_camera", 512)

    @staticmethod
    def _camera(name: str, size: int) -> CameraConfig:
        pose = sapien_utils.look_at(eye=list(model.CAMERA_EYE), target=list(model.CAMERA_TARGET))
        return CameraConfig(name, pose, size, size, model.CAMERA_FOV, 0.05, 20.0)

    def _set_episode_rng(self, seed: Any, env_idx: Any) -> None:
        super()._set_episode_rng(seed, env_idx)
        if seed is not None or self._enhanced_determinism:
            generators = getattr(self, "_generators", None) or [None] * self.num_envs
            for i in env_idx.tolist():
                generators[i] = np.random.default_rng(int(self._episode_seed[i]))
            self._generators: list[Any] = generators

    def _load_agent(self, options: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, ASIDE)

    def _load_scene(self, options: dict[str, Any]) -> None:
        ground = build_ground(self.scene)
        ground.set_collision_group_bit(group=model.IGNORE_GROUP, bit_idx=model.GROUND_BIT, bit=1)
        builder = self.scene.create_articulation_builder()
        builder.initial_pose = sapien.Pose()
        model.add_cabinet(builder, visuals=self.scene.can_render())
        self.cabinet = builder.build(name="cabinet", fix_root_link=True)
        self._doors = [self.cabinet.joints_map[f"door{i}_hinge"] for i in range(2)]
        self._fingers = [self.agent.robot.links_map[name] for name in model.FINGER_LINKS]
        for i, seed in enumerate(self._episode_seed):
            self._set_hinges(i, draw_start(np.random.default_rng(int(seed))))

    def _set_hinges(self, scene: int, start: Any) -> None:
        for door, friction, damping in zip(self._doors, start.friction, start.damping, strict=True):
            door._objs[scene].set_friction(friction)
            door._objs[scene].set_drive_properties(0.0, damping)

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        rows = []
        for i in env_idx.tolist():
            start = draw_start(self._generators[i])
            base = (*start.base, model.START_LIFT) if self.agent.mobile else ()
            rows.append((*base, *model.START_ARM, model.START_FINGER, model.START_FINGER))
            if not self.gpu_sim_enabled:
                self._set_hinges(i, start)
        qpos = torch.tensor(rows, dtype=torch.float32, device=self.device)
        robot, closed = self.agent.robot, torch.zeros(len(rows), 2, device=self.device)
        robot.set_pose(Pose.create(sapien.Pose()))
        robot.set_qpos(qpos)
        robot.set_qvel(torch.zeros_like(qpos))
        self.cabinet.set_qpos(closed)
        self.cabinet.set_qvel(closed)

    def _cabinet_state(self) -> CabinetState:
        robot = self.agent.robot
        poses = [finger.pose for finger in self._fingers]
        return CabinetState(
            robot.get_qpos(),
            robot.get_qvel(),
            torch.stack([pose.p for pose in poses], 1),
            torch.stack([pose.q for pose in poses], 1),
            torch.stack([finger.linear_velocity for finger in self._fingers], 1),
            self.cabinet.get_qpos(),
            self.cabinet.get_qvel(),
        )

    def evaluate(self) -> dict[str, Any]:
        """See :func:`rpg.envs.sapien.cabinet_task.evaluate`."""
        return evaluate(self._cabinet_state(), self.variant)

    def step(self, action: Any) -> tuple[Any, Tensor, Tensor, Tensor, dict[str, Any]]:
        """ManiSkill's step, without its end at success: the reward is per step while the doors are open."""
        obs, value, terminated, truncated, info = super().step(action)
        return obs, value, torch.zeros_like(terminated), truncated, info

    def _get_obs_agent(self) -> dict[str, Any]:
        return {} if self.obs_mode_struct.state else super()._get_obs_agent()

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        if not self.obs_mode_struct.state:
            return {}
        return {"state": observation(self._cabinet_state(), self.variant)}

    def compute_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Any]) -> Tensor:
        """The dense task's reward, whatever the variant: (num_envs,)."""
        value: Tensor = reward(self._cabinet_state(), "dense")
        return value

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Any]) -> Tensor:
        """The dense reward over its greatest value: (num_envs,)."""
        return self.compute_dense_reward(obs, action, info) / BEST_DENSE

    def compute_sparse_reward(self, obs: Any, action: Tensor, info: dict[str, Any]) -> Tensor:
        """1 while both doors are beyond 72 % of their range: (num_envs,)."""
        value: Tensor = reward(self._cabinet_state(), "sparse")
        return value


@register_env("rpg-CabinetDense-v1", max_episode_steps=HORIZON)
class CabinetDenseTask(CabinetTask):
    """The mobile robot and the dense reward."""

    variant = "dense"
    SUPPORTED_ROBOTS = [MobilePanda.uid]  # noqa: RUF012 (as ManiSkill declares it)
    SUPPORTED_REWARD_MODES = ("dense", "normalized_dense", "sparse", "none")

    def __init__(self, *args: Any, robot_uids: str = MobilePanda.uid, **kwargs: Any) -> None:
        super().__init__(*args, robot_uids=robot_uids, **kwargs)


@register_env("rpg-CabinetSparse-v1", max_episode_steps=HORIZON)
class CabinetSparseTask(CabinetTask):
    """The robot with a fixed base and the sparse reward."""

    variant = "sparse"
    SUPPORTED_ROBOTS = [FixedPanda.uid]  # noqa: RUF012 (as ManiSkill declares it)
    SUPPORTED_REWARD_MODES = ("sparse", "dense", "normalized_dense", "none")

    def __init__(self, *args: Any, robot_uids: str = FixedPanda.uid, **kwargs: Any) -> None:
        super().__init__(*args, robot_uids=robot_uids, **kwargs)
