"""Bodies of the cabinet tasks: a two-door kitchen cabinet built from boxes, and the mobile Panda.

World frame: x into the cabinet, y to the robot's left, z up; metres and radians. The cabinet's origin is on
the floor below its middle; its front looks along -x. Door 0 is hinged at y > 0, door 1 at y < 0.

Both simulators that use this module build through SAPIEN's link builders, so nothing here depends on which.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import sapien

from rpg.errors import RPGError

WIDTH, HEIGHT, DEPTH, BOARD = 0.60, 0.72, 0.50, 0.02
DOOR_HEIGHT, DOOR_BOTTOM = 0.66, 0.03
DOOR_WIDTH = WIDTH / 2 - 0.002  # leaves a slit between the doors
HANDLE_INSET = 0.05  # handle axis to the door's free edge
HANDLE_STANDOFF = 0.06  # handle axis to the door's face
HANDLE_RADIUS, HANDLE_LENGTH, HANDLE_Z = 0.010, 0.24, 0.42
DOOR_RANGE = 1.67  # a door turns from 0 (closed) to this
DOOR_SIDE = (1.0, -1.0)  # sign of y of the hinges; a door opens by -side about z
HINGE_X = -DEPTH / 2
HANDLE_X = -BOARD - HANDLE_STANDOFF  # of the handle's axis, from the hinge of a closed door
HANDLE_Y = DOOR_WIDTH - HANDLE_INSET  # the same, towards the middle of the cabinet

BASE_JOINTS = (
    "root_x_axis_joint",
    "root_y_axis_joint",
    "root_z_rotation_joint",
    "linear_actuator_height",
)
ARM_JOINTS = tuple(f"right_panda_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("right_panda_finger_joint1", "right_panda_finger_joint2")
FINGER_LINKS = ("right_panda_rightfinger", "right_panda_leftfinger")  # order of the published observation
BODY_LINKS = ("adjustable_body", "body_base_link", "body_link")

HAND_LINKS = ("right_panda_link7", "right_panda_hand")  # bolted together, overlapping

START_LIFT = 1e-4
START_ARM = (0.0, 0.0, 0.0, -1.5, 0.0, 3.0, 0.78)
START_FINGER = 0.02
FIXED_BASE = (-1.1, 0.0)

IGNORE_GROUP = 2  # SAPIEN's collision group whose equal bits keep two shapes from colliding
GROUND_BIT, CABINET_BIT, HAND_BIT = 30, 28, 27


class Drive(NamedTuple):
    """A PD drive in SAPIEN's terms, and what an action of -1 and 1 mean."""

    stiffness: float
    damping: float
    force_limit: float
    lower: tuple[float, ...]
    upper: tuple[float, ...]


BASE_DRIVE = Drive(0.0, 1000.0, 500.0, (-0.5, -0.5, -3.14, -0.5), (0.5, 0.5, 3.14, 0.5))
ARM_DRIVE = Drive(0.0, 100.0, 100.0, (-3.14,) * 7, (3.14,) * 7)
FINGER_DRIVE = Drive(1000.0, 100.0, 100.0, (-0.01,), (0.04,))
"""Velocity drives for base, lift and arm, a position drive for the fingers, as in ManiSkill2's mobile Panda."""

CONTROL_FREQ, SIM_FREQ = 20, 100  # decisions and sub-steps per second
CONTACT_OFFSET, POSITION_ITERATIONS, VELOCITY_ITERATIONS = 0.02, 15, 1
CAMERA_EYE, CAMERA_TARGET, CAMERA_FOV = (-3.3, 1.5, 1.9), (-0.8, 0.0, 0.35), 0.6
GRIPPER_FRICTION, CABINET_FRICTION, OTHER_FRICTION = 2.0, 1.0, 0.5
FRICTION_RANGE, DAMPING_RANGE = (0.05, 0.15), (5.0, 20.0)  # of door joints, drawn at each reset

Z_FROM_X = sapien.Pose(q=[math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0])  # turns the x axis to z
MINUS_Z_FROM_X = sapien.Pose(q=[math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])


def panda_folder() -> Path:
    """Where the ManiSkill wheel keeps its Panda files; ManiSkill itself is not imported.

    Raises:
        RPGError: ManiSkill is not installed.
    """
    spec = importlib.util.find_spec("mani_skill")
    if spec is None or not spec.submodule_search_locations:
        raise RPGError(
            "cabinet: the robot's files come with the package 'mani_skill', which is not installed; "
            "pip install mani-skill"
        )
    return Path(spec.submodule_search_locations[0]) / "assets" / "robots" / "panda"


def robot_urdf(mobile: bool, visuals: bool) -> str:
    """URDF text of the mobile Panda that ManiSkill ships, with absolute mesh paths.

    Args:
        mobile: keep the four base joints; otherwise they are fixed at the start of the sparse task.
        visuals: keep what only a renderer needs.
    """
    folder = panda_folder()
    root = ElementTree.parse(folder / "mobile_panda_single_arm.urdf").getroot()
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            if not visuals:
                link.remove(visual)
    for mesh in root.iter("mesh"):
        path = folder / mesh.attrib["filename"]
        # The wheel ships binary glTF where its URDF names Collada.
        mesh.set("filename", str(path.with_suffix(".glb") if path.suffix == ".dae" else path))
    for joint in root.iter("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)  # both fingers get the same target; a tendon as well would fight the drives
        if not mobile and joint.attrib["name"] in BASE_JOINTS:
            joint.set("type", "fixed")
    if not mobile:
        for name, place in (
            (BASE_JOINTS[0], f"{FIXED_BASE[0]} {FIXED_BASE[1]} 0"),
            (BASE_JOINTS[3], f"0 0 {START_LIFT}"),
        ):
            joint = next(j for j in root.iter("joint") if j.attrib["name"] == name)
            ElementTree.SubElement(joint, "origin", {"xyz": place, "rpy": "0 0 0"})
    return ElementTree.tostring(root, encoding="unicode")


def prepare_robot(loader: Any) -> None:
    """Surface friction and density settings of a SAPIEN or ManiSkill URDF ``loader``."""
    loader.fix_root_link = True
    for link in FINGER_LINKS:
        loader.set_link_material(link, GRIPPER_FRICTION, GRIPPER_FRICTION, 0.0)
        loader.set_link_patch_radius(link, 0.1)
        loader.set_link_min_patch_radius(link, 0.1)


def filter_robot_collisions(builder: Any) -> None:
    """No contacts of the lift's column, which reaches below the floor, with the ground, nor within the hand."""
    for link in builder.link_builders:
        if link.name in BODY_LINKS:
            link.collision_groups[IGNORE_GROUP] |= 1 << GROUND_BIT
        if link.name in HAND_LINKS:
            link.collision_groups[IGNORE_GROUP] |= 1 << HAND_BIT


def add_cabinet(builder: Any, visuals: bool) -> None:
    """Case, doors and handles on a SAPIEN or ManiSkill articulation ``builder``.

    Args:
        builder: an empty articulation builder; fix its root when building.
        visuals: add what a renderer shows; needs a graphics driver.
    """
    material = sapien.physx.PhysxMaterial(CABINET_FRICTION, CABINET_FRICTION, 0.0)
    case = builder.create_link_builder()
    case.set_name("case")
    middle = HEIGHT / 2
    side_y, top_z = (WIDTH - BOARD) / 2, HEIGHT - BOARD / 2
    for place, half in (
        ((DEPTH / 2 - BOARD / 2, 0.0, middle), (BOARD / 2, WIDTH / 2, middle)),
        ((0.0, side_y, middle), (DEPTH / 2, BOARD / 2, middle)),
        ((0.0, -side_y, middle), (DEPTH / 2, BOARD / 2, middle)),
        ((0.0, 0.0, top_z), (DEPTH / 2, WIDTH / 2, BOARD / 2)),
        ((0.0, 0.0, BOARD / 2), (DEPTH / 2, WIDTH / 2, BOARD / 2)),
    ):
        _board(case, place, half, material, (0.62, 0.48, 0.34) if visuals else None)
    for i, side in enumerate(DOOR_SIDE):
        _add_door(builder, case, i, side, material, visuals)
    for link in builder.link_builders:
        link.collision_groups[IGNORE_GROUP] |= 1 << CABINET_BIT


def _add_door(builder: Any, case: Any, index: int, side: float, material: Any, visuals: bool) -> None:
    """Door ``index``; its frame sits on the hinge at the floor and equals the world's when closed."""
    door = builder.create_link_builder(case)
    door.set_name(f"door{index}")
    door.set_joint_name(f"door{index}_hinge")
    axis = MINUS_Z_FROM_X if side > 0 else Z_FROM_X
    hinge = sapien.Pose([HINGE_X, side * WIDTH / 2, 0.0])
    door.set_joint_properties("revolute", [[0.0, DOOR_RANGE]], hinge * axis, axis, 0.0, 0.0)
    panel_z = DOOR_BOTTOM + DOOR_HEIGHT / 2
    half = (BOARD / 2, DOOR_WIDTH / 2, DOOR_HEIGHT / 2)
    _board(
        door,
        (-BOARD / 2, -side * DOOR_WIDTH / 2, panel_z),
        half,
        material,
        (0.75, 0.62, 0.46) if visuals else None,
    )
    steel = (0.75, 0.75, 0.78) if visuals else None
    handle_y = -side * HANDLE_Y
    bar = sapien.Pose([HANDLE_X, handle_y, HANDLE_Z], Z_FROM_X.q)
    length = HANDLE_LENGTH / 2 - HANDLE_RADIUS
    door.add_capsule_collision(bar, HANDLE_RADIUS, length, material)
    if steel is not None:
        door.add_capsule_visual(bar, HANDLE_RADIUS, length, material=paint(steel))
    for end in (-length, length):
        place = (-BOARD - HANDLE_STANDOFF / 2, handle_y, HANDLE_Z + end)
        _board(door, place, (HANDLE_STANDOFF / 2, 0.006, 0.006), material, steel)


def _board(
    link: Any,
    place: tuple[float, float, float],
    half: tuple[float, float, float],
    material: Any,
    colour: tuple[float, float, float] | None,
) -> None:
    pose = sapien.Pose(np.array(place))
    link.add_box_collision(pose, half, material, density=600.0)
    if colour is not None:
        link.add_box_visual(pose, half, material=paint(colour))


def paint(colour: tuple[float, float, float]) -> Any:
    """A render material of an RGB colour in [0, 1]; needs a graphics driver."""
    return sapien.render.RenderMaterial(base_color=[*colour, 1.0])
