"""Speed against accuracy: the front, `rpg-plot pareto`, and the script of the maze experiment."""

from __future__ import annotations

import csv
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

from rpg.errors import RPGError
from rpg.plot import main
from rpg.stats import pareto_front
from rpg.training.build import build_trainer, parse_config
from rpg.training.flops import gflop_per_update
from rpg.training.loggers import Loggers

ROOT = Path(__file__).parents[1]
TINY = (
    "size.batch_size=16", "size.width=16", "size.state_dim=16", "size.rnd_width=16", "size.rnd_batch_size=16",
    "trainer.seed_decisions=50", "trainer.replay_capacity=200", "compile=false",
)  # fmt: skip
Composed = Callable[..., DictConfig]


@pytest.mark.parametrize(
    ("cost", "value", "front"),
    [
        ([1, 2, 3], [1, 2, 3], [0, 1, 2]),
        ([1, 2, 3], [3, 2, 1], [0]),
        ([3, 1, 2], [9, 5, 4], [1, 0]),
        ([5], [-1], [0]),
        ([2, 2, 1], [3, 4, 1], [2, 1]),  # as quick, but worse
        ([1, 2, 3], [4, 4, 4], [0]),  # as good, but slower
        ([1, 1, 2], [3, 3, 2], [0, 1]),  # equal points stand together
    ],
)
def test_front_is_what_nothing_beats(cost: list[float], value: list[float], front: list[int]) -> None:
    assert pareto_front(cost, value).tolist() == front


def test_front_is_that_of_the_definition_written_out() -> None:
    cost, value = np.random.default_rng(0).integers(0, 12, size=(2, 60))  # with many ties

    def beaten(i: int) -> bool:
        return any(
            cost[j] <= cost[i] and value[j] >= value[i] and (cost[j], value[j]) != (cost[i], value[i])
            for j in range(60)
        )

    front = pareto_front(cost, value)
    assert set(front.tolist()) == {i for i in range(60) if not beaten(i)}
    assert (np.diff(cost[front]) >= 0).all()
    assert (np.diff(value[front]) >= 0).all()


@pytest.mark.parametrize(
    ("cost", "value", "message"),
    [
        ([1, float("nan")], [1, 2], r"cost: score \(1,\) is nan"),
        ([1, 2], [float("inf"), 2], r"value: score \(0,\) is inf"),
        ([1, 2], [1], r"shapes \(2,\) and \(1,\)"),
        ([], [], "no scores"),
    ],
)
def test_front_refuses_what_cannot_be_compared(cost: Any, value: Any, message: str) -> None:
    with pytest.raises(RPGError, match=message):
        pareto_front(cost, value)


# -- rpg-plot pareto ---------------------------------------------------------------------------------------


def make_run(path: Path, size: str, speed: float, gain: float, seed: int = 0, end: int = 40) -> Path:
    loggers = Loggers(path)
    for step in range(10, end + 1, 10):
        counters = {"decisions": step, "env_steps": step, "updates": step, "wall_s": step / speed}
        loggers.log(counters | {"train/coverage": gain * step / 100}, step)
    config = {"agent": {"name": "rpg"}, "env": {"name": "maze"}, "size": {"name": size}, "seed": seed}
    (path / "config.yaml").write_text(yaml.safe_dump(config))
    return path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_chart_and_table_of_three_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed, luck in enumerate((0.9, 1.0, 1.1)):
        make_run(tmp_path / "runs" / f"small{seed}", "small", 10, luck, seed)
    make_run(tmp_path / "runs" / "bad", "bad", 5, 0.5)
    make_run(tmp_path / "runs" / "large", "large", 2, 2.0)
    out = tmp_path / "pareto.png"
    words = ["pareto", str(tmp_path / "runs"), "--group", "agent,size.name", "--out", str(out)]
    assert main(words) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    rows = {row["group"]: row for row in table(out.with_suffix(".csv"))}
    assert ",".join(rows["rpg, bad"]) == "group,env_steps,wall_s,metric,iqm,low,high,seeds,front"
    assert {name: row["front"] for name, row in rows.items()} == {
        "rpg, small": "1",
        "rpg, bad": "0",
        "rpg, large": "1",
    }
    small = rows["rpg, small"]
    assert (small["env_steps"], small["wall_s"], small["iqm"], small["seeds"]) == ("40", "4.0", "0.4", "3")
    assert float(small["low"]) < 0.4 < float(small["high"])
    first = out.read_bytes(), out.with_suffix(".csv").read_bytes()
    assert main(words) == 0
    assert (out.read_bytes(), out.with_suffix(".csv").read_bytes()) == first
    assert capsys.readouterr().err == ""


def test_ends_of_unequal_lengths_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path / "a", "small", 10, 1.0)
    make_run(tmp_path / "b", "large", 10, 1.0, end=80)
    out = str(tmp_path / "p.svg")
    assert main(["pareto", str(tmp_path), "--group", "size", "--out", out]) == 0
    assert "'small' ends at 40 env steps, 'large' at 80" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing"], "no run found at 'nothing'"),
        (["run", "--metric", "train/covrage"], "did you mean 'train/coverage'"),
        (["run", "--group", "agent,size.nam"], "did you mean 'size.name'"),
        (["run", "--out", "p.txt"], "use an ending of .png"),
    ],
)
def test_bad_input_is_answered_in_one_line(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "run", "small", 1, 1)
    assert main(["pareto", *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.glob("p*"))


def test_a_folder_called_pareto_can_still_be_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "pareto", "small", 1, 1)
    assert main(["./pareto"]) == 0
    assert (tmp_path / "plot.png").exists()


# -- operations of an update -------------------------------------------------------------------------------


def test_operations_grow_with_the_batch_and_count_rare_steps_by_their_share(composed: Composed) -> None:
    def gflop(*overrides: str) -> float:
        cfg = composed(*TINY, "exploration=none", *overrides)
        return gflop_per_update(build_trainer(parse_config(cfg)))

    every = [gflop(f"agent.actor_every={n}") for n in (1, 2, 4)]
    assert every[0] - every[1] == pytest.approx(2 * (every[1] - every[2]))
    assert gflop("agent.actor_every=1", "size.batch_size=32") == pytest.approx(2 * every[0])


# -- scripts/chart_speed_accuracy.py -----------------------------------------------------------------------


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, with ``tmp_path`` as the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    return importlib.import_module("chart_speed_accuracy")


def record(
    script: ModuleType, cfg: DictConfig, name: str, wall_s: float, accuracy: float, **where: Any
) -> None:
    """A finished run of two log rows; ``where`` may give env, seed, steps and commit."""
    folder = Path(f"runs/pareto/{where.get('env', 'maze')}/{name}/seed{where.get('seed', 0)}")
    steps = where.get("steps", 40_000)
    loggers = Loggers(folder)
    for part in (0.5, 1.0):
        counters = {"env_steps": int(part * steps), "updates": int(part * steps / 5), "wall_s": part * wall_s}
        row = {"decisions": int(part * steps), "train/coverage": part * accuracy, "time/updates_per_s": 20.0}
        loggers.log(counters | row, int(part * steps))
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(cfg, resolve=True))
    origin = {"command": f"train.py {name}", "commit": where.get("commit", "abc"), "cpu": "X", "cores": 2}
    (folder / "run.json").write_text(json.dumps(origin | {"torch": "2", "threads": 1}))


def test_list_names_every_configuration_with_one_override(
    script: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script.main(["list"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == ["fast"]
    assert all(len(line) == 2 and line[1].count("=") == 1 for line in lines[1:])
    assert len({line[0] for line in lines}) == len(lines)
    assert {line[0].rpartition("-")[0] for line in lines[1:]} == set(script.KNOBS)


def test_every_configuration_differs_from_fast_and_is_valid(script: ModuleType, composed: Composed) -> None:
    base = composed()  # a key that it does not have is refused
    plains = [
        parse_config(OmegaConf.merge(base, OmegaConf.from_dotlist(list(c.overrides)))).plain  # type: ignore[arg-type]
        for c in script.configs().values()
    ]
    assert all(plain != plains[0] for plain in plains[1:])


def test_every_knob_is_described(script: ModuleType) -> None:
    page = (ROOT / "docs" / "speed_accuracy.md").read_text()
    assert [knob for knob, about in script.KNOBS.items() if f"| `{knob}` | `{about.key}` |" not in page] == []


def test_run_screens_then_repeats_the_front(
    script: ModuleType, composed: Composed, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = list(script.configs())
    started: list[list[str]] = []

    def pretend(jobs: Any, count: int) -> int:
        started.append([job.name for job in jobs])
        return 0

    monkeypatch.setattr(script, "run_side_by_side", pretend)
    with pytest.raises(RPGError, match="no finished run with seed 0"):
        script.run([], 2, None)
    ends = [(100, 0.5), (50, 0.5), (200, 0.9), (300, 0.8)]
    for name, (wall_s, accuracy) in zip(names, ends, strict=False):
        record(script, composed(*TINY), name, wall_s, accuracy)
    started.clear()
    assert script.run([], 2, None) == 0
    assert started[0] == [f"{name}, maze, seed 0" for name in names]
    front = ["fast", names[1], names[2]]
    assert started[1] == [
        *(f"{name}, maze, seed {seed}" for seed in (1, 2) for name in front),
        *(f"{name}, maze_medium, seed {seed}" for seed in (0, 1, 2) for name in front),
    ]
    started.clear()
    assert script.run(["fast"], 2, [7]) == 0
    assert started == [["fast, maze, seed 7"]]
    with pytest.raises(SystemExit, match="2"):
        script.main(["run", "fsat"])


def test_gather_and_draw_from_finished_runs(
    script: ModuleType, composed: Composed, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        script.main(["gather"])
    with pytest.raises(SystemExit, match="2"):
        script.main(["draw"])
    names = list(script.configs())[:4]
    small, large = composed(*TINY), composed(*TINY, "size.batch_size=32")
    for seed in range(3):
        record(script, small, names[0], 100, 0.5 + 0.1 * seed, seed=seed)
    record(script, large, names[1], 200, 0.9, commit="def")
    record(script, large, names[2], 10, 0.9, steps=500)
    record(script, small, names[0], 100, 0.3, env="maze_medium")
    capsys.readouterr()
    assert script.main(["gather"]) == 0
    rows = table(Path("results/pareto/learning.csv"))
    assert ",".join(rows[0]) == (
        "config,knob,value,seed,env_steps,wall_s,updates,accuracy,updates_per_s,gflop_per_update"
    )
    assert [(row["config"], row["seed"], row["env_steps"]) for row in rows] == [
        (name, seed, steps)
        for name, seed in ((names[0], "0"), (names[0], "1"), (names[0], "2"), (names[1], "0"))
        for steps in ("20000", "40000")
    ]
    assert (rows[0]["knob"], rows[-1]["knob"]) == ("", names[1].rpartition("-")[0])
    assert (rows[-1]["wall_s"], rows[-1]["accuracy"], rows[-1]["updates"]) == ("200.00", "0.9", "8000")
    assert 0 < float(rows[0]["gflop_per_update"]) < float(rows[-1]["gflop_per_update"])
    origin = json.loads(Path("results/pareto/learning.json").read_text())
    assert origin["commit"] == ["abc", "def"]
    assert (origin["machine"], origin["torch"], origin["threads"]) == ({"cpu": "X", "cores": 2}, "2", 1)
    assert origin["unfinished"] == [f"{names[2]}/seed0"]
    assert origin["runs"][f"{names[1]}/seed0"] == f"train.py {names[1]}"
    assert len(table(Path("results/pareto/learning_maze_medium.csv"))) == 2
    assert script.main(["draw"]) == 0
    for name in ("learning", "learning_maze_medium"):
        assert Path(f"results/pareto/{name}.png").read_bytes().startswith(b"\x89PNG")
