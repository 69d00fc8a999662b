"""The benchmarks run for real on tiny settings; what they measure is never asserted."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

FOLDER = Path(__file__).parents[1] / "benchmarks"
TINY = [
    "size.batch_size=16", "size.width=16", "size.state_dim=8", "size.rnd_width=16", "size.rnd_batch_size=16",
    "trainer.seed_decisions=20", "trainer.replay_capacity=2000",
]  # fmt: skip
QUICK = ["--size=fast", "--threads=1", "--repeats=1", "--no-compile"]
COMMON = [
    "name", "median", "unit", "repeats", "agent", "size", "threads", "dtype", "device", "overrides",
    "cpu", "commit", "torch", "date",
]  # fmt: skip

Script = Callable[[str], ModuleType]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[Script]:
    """``script("learning")``: the module, as it imports its neighbours when it is run."""
    monkeypatch.syspath_prepend(str(FOLDER))
    held = set(sys.modules)

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    yield load
    for path in FOLDER.glob("*.py"):
        if path.stem not in held:
            sys.modules.pop(path.stem, None)


@pytest.fixture(autouse=True)
def short_copies(monkeypatch: pytest.MonkeyPatch, script: Script) -> None:
    copy = script("machine").copy_gb_per_s
    monkeypatch.setattr(script("machine"), "copy_gb_per_s", lambda device: copy(device, megabytes=1))


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    (text,) = capsys.readouterr().out.splitlines()
    line = json.loads(text)
    assert isinstance(line, dict)
    return line


def refusal(capsys: pytest.CaptureFixture[str], main: Callable[[list[str]], None], *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        main(list(words))
    assert stopped.value.code == 2
    said = capsys.readouterr()
    assert not said.out
    (text,) = said.err.splitlines()
    return text


def test_learning_says_what_was_measured(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*QUICK, "--against=eager", "--fill=500", "--dtype=bfloat16", f"--out={tmp_path}", *TINY]
    script("learning").main(words)
    line = printed(capsys)
    assert json.loads((tmp_path / "learning.jsonl").read_text()) == line
    needed = (
        "compile_s compile_failed agent_updates_per_s env_steps_per_s gflop_per_update copy_gb_per_s "
        "peak_memory_mb eager_updates_per_s speedup batch_size horizon num_envs"
    )
    assert {*COMMON, *needed.split()} <= set(line)
    assert line["median"] == line["updates_per_s"] > 0
    assert line["compile"] is False
    assert line["overrides"] == " ".join(TINY)
    assert set(line["matmul_gflops_by_dtype"]) == {"float32", "bfloat16"}
    assert line["matmul_gflops"] == line["matmul_gflops_by_dtype"]["bfloat16"]
    share = line["gflop_per_update"] * line["updates_per_s"] / line["matmul_gflops"]
    assert line["share"] == pytest.approx(share, rel=1e-2)


@pytest.mark.parametrize(("envs", "per_update"), [(1, 5), (5, 5), (7, 5), (50, 5), (2, 0.5)])
def test_the_stretch_of_training_holds_the_updates_due(script: Script, envs: int, per_update: float) -> None:
    args = script("bench").options("doc").parse_args([*QUICK, *TINY])
    overrides = (f"env.num_envs={envs}", f"trainer.decisions_per_update={per_update}")
    with script("bench").started(args, *overrides) as (trainer, run):
        steps, updates = script("learning").schedule(run)
        assert updates >= 4
        assert steps * envs == updates * per_update
        script("learning").prepare(trainer, run)
        decisions = trainer.decisions
        script("learning").works(trainer, run)[2]()
        assert trainer.decisions - decisions == steps * envs
        assert trainer.updates == updates


def test_replay_and_act_print_a_point_for_each_combination(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*QUICK, f"--out={tmp_path}"]
    script("replay").main([*words, "--batches=8,16", "--fills=100", "--envs=2,5", *TINY])
    line = printed(capsys)
    assert set(COMMON) <= set(line)
    cases = [(p["num_envs"], p["fill"], p["batch_size"]) for p in line["points"]]
    assert cases == [(2, 100, 8), (2, 100, 16), (5, 100, 8), (5, 100, 16)]
    assert all(
        p["adds_per_s"] > 0 and p["samples_per_s"] > 0 and p["sample_share"] > 0 for p in line["points"]
    )
    script("act").main([*words, "--envs=1,3", *TINY])
    line = printed(capsys)
    assert set(COMMON) <= set(line)
    assert [p["num_envs"] for p in line["points"]] == [1, 3]
    assert all(p["decisions_per_s"] > 0 and p["env_steps_per_s"] > 0 for p in line["points"])
    assert {path.name for path in tmp_path.iterdir()} == {"act.jsonl", "replay.jsonl"}


def test_planner_times_maps_that_equal_those_of_plain_loops(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planner, words = script("planner"), ["--repeats=1", "--envs=1,3", f"--out={tmp_path}"]
    planner.main([*words, "--landmarks=8,16", "--naive=8"])
    line = printed(capsys)
    assert json.loads((tmp_path / "planner.jsonl").read_text()) == line
    assert (tmp_path / "planner.png").stat().st_size > 1000
    assert [point["landmarks"] for point in line["points"]] == [8, 16]
    assert [("naive_build_s" in point, point["build_s"] > 0) for point in line["points"]] == [
        (True, True),
        (False, True),
    ]
    for point in line["points"]:
        assert [entry["num_envs"] for entry in point["envs"]] == [1, 3]
        assert point["insert_into"] > point["landmarks"] // 2
    assert line["median"] == line["points"][-1]["envs"][-1]["step_ms"] > 0
    text = script("table").tables(tmp_path)
    assert "### Landmark maps" in text
    assert len({row.count("|") for row in text.split("\n\n")[1].splitlines()}) == 1
    true = planner.naive_map
    planner.naive_map = lambda *given: (true(*given)[0], true(*given)[1] + 1)
    assert "not that of the plain loops" in refusal(capsys, planner.main, *words, "--landmarks=8")


def test_planner_behind_a_network(script: Script, capsys: pytest.CaptureFixture[str]) -> None:
    script("planner").main(["--repeats=1", "--envs=2", "--landmarks=6", "--width=8", "--naive=6"])
    line = printed(capsys)
    assert line["name"] == "planner/8"
    assert line["points"][0]["envs"][0]["naive_step_ms"] > 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--dtype=tf32"], "--dtype tf32"),
        (["agent=mbsac"], "--agent"),
        (["size.widht=3"], "size.widht"),
        (["--agent=random"], "agent=random"),
        (["trainer.decisions_per_update=0"], "decisions_per_update"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_a_line(
    script: Script, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    assert said in refusal(capsys, script("learning").main, *QUICK, *words)


def test_growth_resumes(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    growth = script("growth")
    monkeypatch.setattr(
        growth, "KNOBS", {"replay": (*growth.KNOBS["replay"][:1], [200], growth.KNOBS["replay"][2])}
    )
    words = ["--repeats=1", "--only=replay", f"--out={tmp_path}", *TINY]
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parent))
    growth.main(words)  # in a process of its own, as always
    line = json.loads((tmp_path / "growth.jsonl").read_text())
    assert (line["knob"], line["value"], line["fill"]) == ("replay", 200, 200)
    assert "trainer.replay_capacity=200" in line["overrides"]
    assert line["peak_memory_mb"] > 0
    assert (tmp_path / "growth.png").exists()
    measured: list[list[str]] = []
    monkeypatch.setattr(growth, "apart", lambda name, words: measured.append(words) or dict(line))
    monkeypatch.setitem(growth.KNOBS, "replay", ("replay", [200, 300], growth.KNOBS["replay"][2]))
    growth.main(words)
    assert [w for words in measured for w in words if "fill" in w] == ["--fill=300"]
    growth.main([*words[:3], "--again", *TINY])
    assert len(measured) == 3
    assert len((tmp_path / "growth.jsonl").read_text().splitlines()) == 4
    capsys.readouterr()
    assert "'replay'" in refusal(capsys, growth.main, "--only=relay")


def test_gpu_refuses_without_one(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "no usable GPU" in refusal(capsys, script("gpu").main, f"--out={tmp_path}")
    assert not list(tmp_path.iterdir())


def test_gpu_parts(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gpu = script("gpu")
    asked: list[list[str]] = []

    def apart(name: str, words: list[str]) -> dict[str, Any]:
        asked.append(words)
        if "env.num_envs=50" in words:
            raise gpu.RPGError("out of memory")
        return {"name": name}

    monkeypatch.setattr(gpu, "apart", apart)
    words = ["--device=cpu", *QUICK, f"--out={tmp_path}"]
    gpu.main([*words, "--parts=precision,envs", *TINY])
    gpu.main([*words, "--parts=kernels", *TINY])
    result = json.loads((tmp_path / "gpu.json").read_text())
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result
    assert result["envs"]["lines"][1] == {"failed": "out of memory"}
    assert len(result["precision"]["lines"]) == 2
    assert [w for words in asked for w in words if w.startswith("env.num")] == [
        f"env.num_envs={n}" for n in (5, 50, 500)
    ]
    kernels = result["kernels"]["lines"]
    assert len(kernels) == 10
    assert [k["us_per_update"] for k in kernels] == sorted(
        (k["us_per_update"] for k in kernels), reverse=True
    )
    options = script("bench").options("doc").parse_args(["--device=cuda"])
    options.envs = [5]
    for part in ("precision", "envs", "mujoco"):  # learning.py knows every option that it is given
        for asked_for in gpu.commands(options, part):
            parsed = script("bench").options("doc")
            parsed.add_argument("--against")
            assert parsed.parse_args(asked_for).device == "cuda"


def test_table_is_what_the_lines_say(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, page = script("table"), tmp_path / "README.md"
    line = {"name": "learning/rpg/paper", "cpu": "A", "threads": 2, "dtype": "float32", "commit": "old"}
    line |= {"updates_per_s": 3.0, "env_steps_per_s": 15.0, "gflop_per_update": 32.0, "share": 0.5}
    newer = line | {"commit": "new", "updates_per_s": 3.25, "compile": False}
    lines = [line, newer, newer | {"compile": True, "updates_per_s": 6.5, "speedup": 2.0}]
    lines += [newer | {"knob": "batch", "value": 3, "updates_per_s": 77.0}]
    (tmp_path / "learning.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in lines))
    refused = refusal(capsys, table.main, f"--output={tmp_path}", f"--page={page}")
    assert table.BEGIN in refused
    page.write_text(f"before\n\n{table.BEGIN}\nold\n{table.END}\nafter\n")
    table.main([f"--output={tmp_path}", f"--page={page}"])
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "old" not in text
    rows = [row for row in text.splitlines() if row.startswith("| learning")]
    assert rows == [
        "| learning/rpg/paper | A | 2 | float32 | no | 3.25 |  | 15 | 32 | 0.5 |  | new |",
        "| learning/rpg/paper | A | 2 | float32 | yes | 6.5 | 2 | 15 | 32 | 0.5 |  | new |",
    ]
    assert "3.5" in text
    assert "13.3 to 16.2" in text
    table.main([f"--output={tmp_path}", f"--page={page}"])
    assert page.read_text() == text


def test_table_takes_all_scripts_lines(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script("act").main([*QUICK, "--envs=1", f"--out={tmp_path}", *TINY])
    script("replay").main([*QUICK, "--batches=8", "--fills=100", "--envs=2", f"--out={tmp_path}", *TINY])
    text = script("table").tables(tmp_path)
    assert "### Acting" in text
    assert "### Replay" in text
    assert "Learning" not in text
    for row in text.split("\n\n")[1::2]:
        assert len({cells.count("|") for cells in row.splitlines()}) == 1


def test_the_page_is_up_to_date(script: Script, tmp_path: Path) -> None:
    page = tmp_path / "README.md"
    page.write_text((FOLDER / "README.md").read_text())
    script("table").main([f"--page={page}"])
    assert page.read_text() == (FOLDER / "README.md").read_text()
