from __future__ import annotations

import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from worlds import SPEC, planner_of, states_at, straight

from rpg.errors import RPGError
from rpg.landmarks import LandmarkPlanner, PlannerConfig
from rpg.landmarks.picture import draw_map, paint_map

LINE = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [5.0, 0.0]])
STATE, GOAL = states_at(torch.tensor([[0.2, 0.0]]))[0], torch.tensor([6.0, 0.0])


def test_a_panel_holds_landmarks_edges_walls_and_the_way() -> None:
    planner = planner_of(LINE, tau=1.5)
    axes = Figure().subplots()
    paint_map(axes, planner, straight, STATE, GOAL, walls=[[0, 1, 5, 1], [0, -1, 5, -1]])
    short, long, walls, dots, lost = axes.collections
    assert [len(lines.get_segments()) for lines in (short, long, walls)] == [4, 1, 2]
    assert to_hex(short.get_color()[0]) != to_hex(long.get_color()[0])
    assert sorted(map(tuple, dots.get_offsets())) == sorted(map(tuple, LINE.tolist()))
    values = dict(zip(map(tuple, dots.get_offsets()), dots.get_array(), strict=True))
    assert values[0.0, 0.0] == pytest.approx(6.0)
    assert len(lost.get_offsets()) == 0
    way, start, goal = axes.lines
    assert way.get_xdata().tolist() == pytest.approx([0.2, 1.0, 2.0, 5.0, 6.0])
    assert (start.get_xdata()[0], goal.get_xdata()[0]) == (pytest.approx(0.2), 6.0)
    assert axes.get_xlim()[0] < 0
    assert axes.get_xlim()[1] > 6


def test_landmarks_without_a_way_are_hollow() -> None:
    places = torch.cat([LINE[:3], LINE[:3] + 50])
    planner = planner_of(places, tau=1.5)
    axes = Figure().subplots()
    paint_map(axes, planner, straight, STATE, torch.tensor([50.4, 50.0]))
    *_, dots, lost = axes.collections
    assert sorted(map(tuple, lost.get_offsets())) == sorted(map(tuple, LINE[:3].tolist()))
    assert len(dots.get_offsets()) == 3


def test_a_frame_shows_the_map_and_changes_with_it() -> None:
    planner = planner_of(LINE, tau=1.5)
    frames = [draw_map(planner, straight, STATE, goal) for goal in (GOAL, GOAL / 2)]
    assert all(frame.shape == (560, 640, 3) and frame.dtype == np.uint8 for frame in frames)
    assert np.ptp(frames[0]) > 200
    assert (frames[0] != frames[1]).any()
    turned = draw_map(planner, straight, STATE, GOAL, place=lambda goals: goals[:, ::-1])
    assert (turned != frames[0]).any()


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(RPGError, match="no map yet"):
        draw_map(LandmarkPlanner(SPEC, PlannerConfig()), straight, STATE, GOAL)
    with pytest.raises(RPGError, match="'place'"):
        draw_map(planner_of(LINE), straight, STATE, GOAL, place=lambda goals: goals[:, :1])
