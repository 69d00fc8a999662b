"""Maps of cells: geometry of the published ones, merged walls, free places, bad maps. Needs no simulator."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from rpg.envs.mujoco.cell_map import MAPS, CellMap, rectangles
from rpg.errors import RPGError


def places(centres: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(centre) for centre in centres.tolist()}


def test_ant_push_is_the_published_map() -> None:
    push = MAPS["push"]
    assert (push.cell, push.wall_height, push.floor_height) == (8.0, 4.0, 0.0)
    assert places(push.free_centres) == {(0, 0), (-8, 0), (-8, 8), (8, 8), (0, 16)}
    [(row, column, axes)] = push.block_cells
    assert (places(push.centres([(row, column)])), axes) == ({(0, 8)}, "xy")
    assert push.goal == (0, 19)
    assert push.character_at(push.goal) == "."
    assert push.walls.sum() == 25 - 6
    np.testing.assert_array_equal(push.bounds, [(-20, -12), (20, 28)])


def test_ant_maze_is_a_u() -> None:
    maze = MAPS["maze"]
    assert places(maze.free_centres) == {(0, 0), (8, 0), (16, 0), (16, 8), (16, 16), (8, 16), (0, 16)}
    assert maze.goal == (0, 16)


def test_ant_fall_has_a_chasm_between_start_and_goal() -> None:
    fall = MAPS["fall"]
    assert places(fall.free_centres) == {(0, 0), (8, 0), (0, 8), (0, 24), (8, 24)}
    assert places(fall.centres(np.argwhere(fall.chasms))) == {(0, 16), (8, 16)}
    [(row, column, axes)] = fall.block_cells
    assert (places(fall.centres([(row, column)])), axes) == ({(8, 8)}, "yz")
    assert fall.floor_height == 4.0
    assert fall.goal == (0, 27, 4.5)


@pytest.mark.parametrize(("size", "share"), [(1, 0.5), (5, 0.2), (14, 0.5), (30, 0.9)])
def test_rectangles_cover_each_true_cell_once_and_no_other(size: int, share: float) -> None:
    rng = np.random.default_rng(size)
    for _ in range(10):
        mask = rng.random((size, size + 3)) < share
        cover = np.zeros(mask.shape, dtype=int)
        for top, bottom, left, right in rectangles(mask):
            cover[top : bottom + 1, left : right + 1] += 1
        np.testing.assert_array_equal(cover, mask)


def test_long_walls_are_single_boxes() -> None:
    assert rectangles(np.ones((7, 9), dtype=bool)) == [(0, 6, 0, 8)]
    room = np.ones((58, 58), dtype=bool)
    room[1:-1, 1:-1] = False
    room[20:40, 28] = True
    assert len(rectangles(room)) == 5


def test_free_places_keep_clear_of_walls_blocks_and_chasms() -> None:
    push = MAPS["push"]
    points = [(0, 0), (0, 3.2), (3.9, 0), (4.1, 0), (-4, 1), (0, 8), (0, 27), (1e9, 0), (np.nan, 0)]
    assert push.is_free(points).tolist() == [True, True, True, False, True, False, False, False, False]
    assert push.is_free(points, 1.0).tolist() == [True, False, False, False, True, False, False, False, False]
    assert not MAPS["fall"].is_free((0, 16))
    assert push.is_free(np.zeros((3, 4, 2))).shape == (3, 4)
    assert push.is_free(push.free_centres, 4.0 - 1e-9).all()


def test_clearance_wider_than_a_cell_sees_every_cell_between() -> None:
    rng = np.random.default_rng(0)
    inner = rng.random((10, 10)) < 0.1
    rows = ["#" * 12, *("#" + "".join("#" if wall else "." for wall in row) + "#" for row in inner), "#" * 12]
    rows[5] = rows[5][:5] + "R" + rows[5][6:]
    tiny = CellMap(tuple(rows), cell=0.5, wall_height=0.5)
    centres, walls = rng.uniform(-2, 2, (300, 2)), tiny.centres(np.argwhere(tiny.walls))
    # A square of half side 0.8 and a cell of half side 0.25 overlap where their centres are nearer than both.
    expected = ~(np.abs(centres[:, None] - walls).max(axis=2) < 0.8 + 0.25).any(axis=1)
    assert 0 < expected.sum() < 300
    np.testing.assert_array_equal(tiny.is_free(centres, 0.8), expected)


ROOM = ("###", "#R#", "###")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rows": ()}, "give rows of one length"),
        ({"rows": ("###", "#R##", "###")}, "give rows of one length"),
        ({"rows": ("###", "#.#", "###")}, "0 cells are 'R'; one must be"),
        ({"rows": ("####", "#RR#", "####")}, "2 cells are 'R'; one must be"),
        ({"rows": ("###", "#R.", "###")}, "row 1, column 2 lies on the border and must be '#'"),
        ({"rows": ("####", "#RX#", "####")}, r"unknown characters \['X'\]; describe them in blocks"),
        ({"rows": ROOM, "blocks": {"B": "xq"}}, "'B' slides along 'xq'; use some of x, y, z"),
        ({"rows": ROOM, "blocks": {"B": "xx"}}, "'B' slides along 'xx'; use some of x, y, z"),
        ({"rows": ROOM, "blocks": {"B": ""}}, "'B' slides along ''; use some of x, y, z"),
        ({"rows": ROOM, "blocks": {"B": "xz"}}, "'B' slides along z, but there is no chasm '~'"),
        ({"rows": ROOM, "blocks": {"#": "x"}}, "'#' cannot stand for a block; take another character"),
        ({"rows": ROOM, "cell": 0.0}, r"cell 0\.0 and wall_height 4\.0 must be positive"),
        ({"rows": ROOM, "wall_height": -1.0}, r"wall_height -1\.0 must be positive"),
    ],
)
def test_bad_maps(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message):
        CellMap(**arguments)


def test_registering_imports_no_simulator() -> None:
    code = (
        "import sys; from rpg.envs.mujoco.registration import register_mujoco; register_mujoco(); "
        "register_mujoco(); import gymnasium; gymnasium.spec('rpg/AntPush-v0'); assert 'mujoco' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
