"""MJCF scenes: gymnasium's ant on a map of cells."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from importlib.resources import files

from rpg.envs.mujoco.cell_map import CellMap, Floats, Mask, rectangles
from rpg.errors import RPGError

TORQUE = 30.0
"""Of a motor at an action of 1."""
GOAL_SITE = "goal"
TOP_CAMERA = "top"

_TIMESTEP = 0.02
_SOLIMP = ".8 .8 .01"
_SOLIMP_BLOCKS = ".995 .995 .01"  # harder contacts, so that a pushed block does not sink in
_BLOCK_MASS, _FALLING_MASS = 0.0002, 0.001
_FALLING_SHARE = 0.99  # a block that falls must fit between the walls of its chasm
_FIELD_OF_VIEW = 45.0  # degrees
_JOINT_MARGIN = "0.01"
_COLORS = {
    "wall": "0.4 0.4 0.4 1",
    "floor": "0.9 0.9 0.9 1",
    "block": "0.9 0.1 0.1 1",
    "goal": "0.1 0.8 0.1 1",
}


def gymnasium_asset(name: str) -> str:
    """The text of an MJCF file that gymnasium ships, such as ``ant.xml``."""
    return (files("gymnasium") / "envs" / "mujoco" / "assets" / name).read_text(encoding="utf-8")


def ant_scene(cell_map: CellMap) -> str:
    """MJCF of the ant on ``cell_map``, to the published sizes (Nachum et al. 2018).

    The robot is gymnasium's ant with motors of 30 instead of 150, a step of 0.02 s, and softer contacts where
    nothing is to be pushed. Neighbouring walls are one box. Blocks are bodies ``block_0``, ... in the order of
    :attr:`CellMap.block_cells`; the camera ``top`` sees the whole map; the site ``goal`` only shows.
    """
    root = ET.fromstring(gymnasium_asset("ant.xml"))
    _part(root, "option").set("timestep", str(_TIMESTEP))
    for motor in root.iter("motor"):
        motor.set("gear", str(TORQUE))
    _part(root, "default/geom").set("solimp", _SOLIMP_BLOCKS if cell_map.block_cells else _SOLIMP)
    _part(root, "worldbody/body[@name='torso']").set("pos", _text(0, 0, 0.75 + cell_map.floor_height))

    low, high = cell_map.bounds
    middle = (low + high) / 2
    half_size = abs(middle) + high - low
    _part(root, "worldbody/geom[@name='floor']").set("size", _text(*half_size, 40))
    squares = _part(root, "asset/material[@name='MatPlane']")
    squares.set("texrepeat", _text(*(2 * half_size / cell_map.cell)))  # two to the side of a cell
    squares.set("reflectance", "0")
    squares.set("specular", "0")
    _part(root, "asset/texture[@name='texplane']").set("rgb1", "0.65 0.65 0.65")

    world = _part(root, "worldbody")
    if cell_map.chasms.any():
        _boxes(world, "floor", cell_map, ~cell_map.chasms, 0.0)
    _boxes(world, "wall", cell_map, cell_map.walls, cell_map.floor_height)
    for number, (row, column, axes) in enumerate(cell_map.block_cells):
        _block(world, f"block_{number}", cell_map, cell_map.centres([(row, column)])[0], axes)

    top = cell_map.floor_height + cell_map.wall_height
    distance = 1.05 * (high - low).max() / 2 / math.tan(math.radians(_FIELD_OF_VIEW / 2))
    place = _text(*middle, top + distance)
    ET.SubElement(world, "camera", name=TOP_CAMERA, pos=place, xyaxes="1 0 0 0 1 0", fovy=str(_FIELD_OF_VIEW))
    ET.SubElement(
        world,
        "site",
        name=GOAL_SITE,
        type="sphere",
        size="0.5",
        pos=_text(*middle, top),
        rgba=_COLORS["goal"],
    )  # not where its body is, or MuJoCo would not look at its position again
    return ET.tostring(root, encoding="unicode")


def _boxes(world: ET.Element, kind: str, cell_map: CellMap, mask: Mask, bottom: float) -> None:
    """Boxes as high as walls over the cells of ``mask``."""
    height, cell = cell_map.wall_height, cell_map.cell
    for number, (first, last, left, right) in enumerate(rectangles(mask)):
        centre = cell_map.centres([(first, left), (last, right)]).mean(axis=0)
        size = _text((right - left + 1) * cell / 2, (last - first + 1) * cell / 2, height / 2)
        place = _text(*centre, bottom + height / 2)
        _solid(world, f"{kind}_{number}", size, pos=place, rgba=_COLORS[kind])


def _block(world: ET.Element, name: str, cell_map: CellMap, centre: Floats, axes: str) -> None:
    falls = "z" in axes
    cell, height, floor = cell_map.cell, cell_map.wall_height, cell_map.floor_height
    half = cell / 2 * (_FALLING_SHARE if falls else 1.0)
    body = ET.SubElement(world, "body", name=name, pos=_text(*centre, floor + height / 2))
    mass = _FALLING_MASS if falls else _BLOCK_MASS
    _solid(body, f"{name}_geom", _text(half, half, height / 2), mass=str(mass), rgba=_COLORS["block"])
    directions = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    ranges = {"x": (-cell, cell), "y": (-cell, cell), "z": (-floor, 0.0)}
    for axis in axes:
        ET.SubElement(
            body,
            "joint",
            name=f"{name}_{axis}",
            type="slide",
            axis=directions[axis],
            armature="0",
            damping="0",
            limited="true" if falls else "false",
            range=_text(*ranges[axis]),
            margin=_JOINT_MARGIN,
        )


def _solid(parent: ET.Element, name: str, size: str, **attributes: str) -> None:
    """A box that everything collides with."""
    ET.SubElement(parent, "geom", attributes, name=name, type="box", size=size, contype="1", conaffinity="1")


def _part(root: ET.Element, path: str) -> ET.Element:
    """The element at ``path``.

    Raises:
        RPGError: gymnasium's file is built otherwise than it was.
    """
    found = root.find(path)
    if found is None:
        raise RPGError(f"gymnasium's ant.xml has no '{path}'; install gymnasium 1.x")
    return found


def _text(*numbers: float) -> str:
    return " ".join(f"{number:g}" for number in numbers)
