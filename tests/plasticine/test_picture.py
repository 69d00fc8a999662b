from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch

from rpg.errors import RPGError
from rpg.plasticine.picture import BODIES, TARGET, TOOLS, Painter, film
from rpg.plasticine.raster import Camera
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.scenes import scene_names

pytest.importorskip("numba")

GROUND = (0.83, 0.84, 0.85)
KINDS = {"body": BODIES[0], "tool": TOOLS, "target": TARGET, "ground": GROUND}


def kind(pixel: np.ndarray) -> str:
    """What a pixel shows, by its hue whatever the light."""
    colour = pixel / max(float(pixel.sum()), 1.0)
    return min(KINDS, key=lambda name: np.abs(colour - np.array(KINDS[name]) / sum(KINDS[name])).sum())


def shown(frame: np.ndarray, painter: Painter, point: Any) -> str:
    row, column = painter.project(np.array([point], dtype=np.float64))[0]
    return kind(frame[row, column])


def scene_of(tool: dict[str, Any] | None = None, **changes: Any) -> Scene:
    """A ball in the air, with one tool far from it."""
    ball = {"shape": "ball", "size": [0.1], "centre": [0.4, 0.4, 0.5], "particles": 2000}
    tools = [{"motion": "fixed", **tool}] if tool else []
    return load_scene({"name": "picture", "bodies": [ball], "tools": tools, **changes})


SPHERE = {"shape": "sphere", "size": [0.06], "position": [0.7, 0.4, 0.5]}


@pytest.mark.parametrize("task", scene_names())
def test_body_tools_and_target_are_where_they_should_be(task: str) -> None:
    scene = load_scene(task, particles=3000)
    state = scene.initial_state()
    painter = Painter(scene, 128)
    frame = painter.frame(state)
    assert (frame.shape, frame.dtype) == ((128, 128, 3), np.uint8)
    assert {kind(pixel) for pixel in frame.reshape(-1, 3)} >= {"body", "tool", "ground"}

    bare = painter.frame(state, tools=False, target=0)
    body = state.particles.x[0][torch.arange(0, 3000, 100)]
    seen = [shown(bare, painter, point) for point in body.tolist()]
    multicoloured = task in ("triple_move", "assembly", "table")
    assert multicoloured or seen.count("body") >= 28

    goal = painter.frame(state, body=False, tools=False, target=1.0)
    nodes = (scene.target.mass > 0.5 * scene.target.mass.max()).nonzero() / scene.target.grid
    assert [shown(goal, painter, node) for node in nodes[::20].tolist()].count("target") > 0.9 * len(
        nodes[::20]
    )

    alone = painter.frame(state, body=False, target=0)
    for tool, pose in zip(scene.tools, state.poses[0].tolist(), strict=True):
        middle = {
            "torus": [pose[0] + tool.size[0], *pose[1:3]],
            "chopsticks": [pose[0] + pose[7] / 2, pose[1] - tool.size[0] / 2, pose[2]],
        }.get(tool.shape, pose[:3])
        assert shown(alone, painter, middle) == "tool"


def test_what_is_nearer_hides_what_is_further() -> None:
    scene = scene_of(SPHERE)
    painter = Painter(scene, 96)
    state = scene.initial_state()
    centre = [0.4, 0.4, 0.5]
    toward = np.array([0.28, 0.5, 1.0]) / np.linalg.norm([0.28, 0.5, 1.0])
    assert shown(painter.frame(state), painter, centre) == "body"
    for side, wanted in ((0.25, "tool"), (-0.25, "body")):
        poses = state.poses.clone()
        poses[0, 0, :3] = torch.from_numpy(np.array(centre) + side * toward)
        assert shown(painter.frame(state._replace(poses=poses)), painter, centre) == wanted


@pytest.mark.parametrize("turn", [[1.0, 0, 0, 0], [0.9, 0.3, -0.2, 0.4]])
@pytest.mark.parametrize(
    ("shape", "size", "inside", "outside"),
    [
        ("sphere", [0.1], [[0, 0, 0], [0.07, 0.05, 0]], [0.0, 0.13, 0.0]),
        ("capsule", [0.3, 0.03], [[0, 0.15, 0], [0, -0.15, 0]], [0.08, 0.0, 0.0]),
        ("box", [0.15, 0.03, 0.05], [[0.14, 0, 0.04], [-0.14, 0.02, -0.04]], [0.0, 0.12, 0.0]),
        ("cylinder", [0.1, 0.05], [[0.09, 0, 0], [0, 0.04, 0.08]], [0.0, 0.18, 0.0]),
        ("torus", [0.12, 0.03], [[0.12, 0, 0], [0, 0, -0.12]], [0.0, 0.12, 0.0]),
    ],
)
def test_every_shape_of_tool_is_drawn_turned_as_it_is(
    shape: str, size: list[float], inside: list[list[float]], outside: list[float], turn: list[float]
) -> None:
    from rpg.plasticine.kinematics import rotation_matrix

    tool = {"shape": shape, "size": size, "position": [0.6, 0.5, 0.5], "rotation": turn}
    scene = scene_of(tool)
    camera = Camera((0.9, 0.8, 2.0), (0.6, 0.5, 0.5), 25.0)
    painter = Painter(scene, 128, camera)
    frame = painter.frame(scene.initial_state(), body=False)
    turned = rotation_matrix(torch.tensor(turn, dtype=torch.float64)).numpy()
    centre = np.array([0.6, 0.5, 0.5])
    for point in inside:
        assert shown(frame, painter, centre + turned @ point) == "tool"
    if turn[0] == 1.0:
        assert shown(frame, painter, centre + outside) != "tool"


def test_a_ring_has_a_hole() -> None:
    scene = scene_of({"shape": "torus", "size": [0.12, 0.03], "position": [0.6, 0.5, 0.5]})
    painter = Painter(scene, 96, Camera((0.61, 2.5, 0.6), (0.6, 0.5, 0.5), 25.0))
    frame = painter.frame(scene.initial_state(), body=False)
    assert shown(frame, painter, [0.6, 0.5, 0.5]) == "ground"
    assert shown(frame, painter, [0.72, 0.5, 0.5]) == "tool"


def test_a_body_in_the_air_casts_a_shadow() -> None:
    scene = scene_of()
    painter = Painter(scene, 64, Camera((0.5, 2.2, 2.2), (0.5, 0.2, 0.5), 40.0))
    state = scene.initial_state()
    lit, dark = painter.frame(state, body=False).astype(int), painter.frame(state).astype(int)
    darker = (lit - dark > 20).all(-1) & np.array(
        [[kind(pixel) == "ground" for pixel in row] for row in dark]
    )
    assert 10 < darker.sum() < 400


def test_scenes_of_a_batch_are_drawn_apart() -> None:
    scene = scene_of(SPHERE)
    state = scene.initial_state(2)
    poses = state.poses.clone()
    poses[1, 0, 1] += 0.1
    painter = Painter(scene, 48)
    one, two = (painter.frame(state._replace(poses=poses), index) for index in (0, 1))
    np.testing.assert_array_equal(one, painter.frame(scene.initial_state()))
    assert (one != two).any()


@pytest.mark.parametrize("count", [1, 40, 400])
def test_few_particles_are_drawn_too(count: int) -> None:
    scene = scene_of(particles=count)
    frame = Painter(scene, 65).frame(scene.initial_state())
    assert frame.shape == (65, 65, 3)
    assert "body" in {kind(pixel) for pixel in frame.reshape(-1, 3)}


def test_what_is_out_of_view_or_behind_is_left_out() -> None:
    scene = scene_of(SPHERE)
    away = Camera((0.5, 0.5, 2.0), (0.5, 0.7, 4.0))
    frame = Painter(scene, 32, away).frame(scene.initial_state())
    assert {kind(pixel) for pixel in frame.reshape(-1, 3)} == {"ground"}


def test_a_picture_too_small_is_refused() -> None:
    with pytest.raises(RPGError, match="picture-v1: picture size=8 must be at least 16"):
        Painter(scene_of(), 8)


@pytest.fixture(scope="module")
def moving() -> Scene:
    return load_scene("move", particles=300)


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_has_a_picture_for_every_step(moving: Scene, tmp_path: Path, suffix: str) -> None:
    actions = torch.zeros(3, 6)
    actions[:, 1] = 1.0
    path = tmp_path / "folder" / f"film{suffix}"
    last = film(moving, actions, path, size=48, fps=10)
    assert last.time == 3
    frames = [np.asarray(frame)[..., :3] for frame in imageio.get_reader(path)]
    assert len(frames) >= (1 + 3 + 5 if suffix == ".mp4" else 4)  # a gif joins equal pictures
    assert frames[0].shape == (48, 48, 3)
    assert np.abs(frames[0].astype(int) - frames[-1].astype(int)).max() > 60


def test_bad_films_are_refused_in_one_line(moving: Scene, tmp_path: Path) -> None:
    with pytest.raises(RPGError, match=r"video .*film\.avi: choose a name that ends with \.mp4 or \.gif"):
        film(moving, torch.zeros(1, 6), tmp_path / "film.avi", size=32)
    with pytest.raises(RPGError, match=r"move-v1: actions have shape \(6,\); wanted \(T, 6\)"):
        film(moving, torch.zeros(6), tmp_path / "film.mp4")
    (tmp_path / "file").write_text("")
    with pytest.raises(RPGError, match="choose another place"):
        film(moving, torch.zeros(1, 6), tmp_path / "file" / "film.mp4", size=32)
