"""The documentation holds: commands run as written, examples run, and what is named exists."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from rpg.agents import (
    CEMConfig,
    GoalDDPGConfig,
    GoalDQNConfig,
    HindsightConfig,
    LatentConfig,
    PlannerConfig,
    PolicyConfig,
    PriorConfig,
    RPGConfig,
    SACConfig,
    TDMPCConfig,
    WorldModelConfig,
)
from rpg.envs.config import EnvConfig
from rpg.exploration import Plan2ExploreConfig, RNDConfig

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md")),
]
RUN_PAGES = ("README.md", "docs/quickstart.md")
EXAMPLE_PAGES = ("README.md", "docs/agents.md", "docs/environments.md", "docs/landmarks.md")

SMALL = ["experiment=debug", "trainer.steps=60", "trainer.seed_decisions=40", "trainer.eval_every=0"]
# Folders are named as the user's would be, so that later commands find what earlier ones made.
FOLDER = "hydra.job.config.override_dirname.exclude_keys=[agent,env,seed,{}]".format(
    ",".join(text.split("=")[0] for text in SMALL)
)


def text(page: str) -> str:
    return (ROOT / page).read_text()


def fences(page: str, *languages: str) -> list[str]:
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text(page), re.MULTILINE | re.DOTALL)
    return [block for language, block in blocks if language in languages]


def shell_lines(page: str, *languages: str) -> list[list[str]]:
    """The commands of a page's fences as words, comments dropped."""
    lines = [
        shlex.split(line, comments=True) for block in fences(page, *languages) for line in block.splitlines()
    ]
    return [words for words in lines if words]


def examples(page: str) -> list[str]:
    return re.findall(r"^<!-- runnable -->\n```python\n(.*?)^```$", text(page), re.MULTILINE | re.DOTALL)


def split_environment(words: list[str]) -> tuple[dict[str, str], list[str]]:
    """``A=1 command x`` -> ({"A": "1"}, ["command", "x"])."""
    count = next(i for i, word in enumerate(words) if not re.fullmatch(r"[A-Z_]+=.*", word))
    return dict(word.split("=", 1) for word in words[:count]), words[count:]


def shrunk(words: list[str]) -> list[str]:
    """An ``rpg-...`` command as a module of this checkout; training with the debug preset, sweeps of two jobs."""
    program, *args = words
    command = [sys.executable, "-m", f"rpg.{program.removeprefix('rpg-')}"]
    if program != "rpg-train" or "--cfg" in args:
        return [*command, *args]
    if "-m" in args:
        swept = [i for i, arg in enumerate(args) if "," in arg]
        for order, i in enumerate(swept):
            args[i] = ",".join(args[i].split(",")[: 1 if order else 2])
    return [*command, *(arg for arg in args if arg not in SMALL), *SMALL, FOLDER]


@pytest.mark.timeout(1200)  # a minute on an idle core: a process for each command
def test_commands_run_as_written_one_after_the_other(tmp_path: Path) -> None:
    written = [split_environment(words) for page in RUN_PAGES for words in shell_lines(page, "bash")]
    commands = {
        tuple(shrunk(words)): (words, variables)
        for variables, words in written
        if words[0].startswith("rpg-")
    }
    assert {words[0] for words, _ in commands.values()} == {"rpg-train", "rpg-evaluate", "rpg-plot"}
    for command, (words, variables) in commands.items():
        if "logger=wandb" in words and importlib.util.find_spec("wandb") is None:
            continue
        env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **variables}
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{shlex.join(words)}\n{done.stdout}\n{done.stderr}"
    table = text("docs/quickstart.md").split("## What a run leaves")[1].split("Every row")[0]
    for name in re.findall(r"`([\w./]+)`", "\n".join(re.findall(r"^\| (.*?) \|", table, re.MULTILINE))):
        assert (tmp_path / "runs/maze/rpg/seed0" / name).exists(), name
    assert (tmp_path / "coverage.png").exists()


EXAMPLES = [(page, code) for page in EXAMPLE_PAGES for code in examples(page)]


@pytest.mark.parametrize(
    "code", [code for _, code in EXAMPLES], ids=[f"{page}-{i}" for i, (page, _) in enumerate(EXAMPLES)]
)
def test_examples_run(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "example.py").write_text(code)
    runpy.run_path(str(tmp_path / "example.py"))
    assert capsys.readouterr().out


def test_every_page_with_examples_has_some() -> None:
    assert all(examples(page) for page in EXAMPLE_PAGES)


@pytest.mark.parametrize("page", PAGES)
def test_make_targets_and_scripts_of_commands_exist(page: str) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for words in shell_lines(page, "bash", ""):
        if words[0] == "make":
            assert words[1] in targets
        elif words[0] == "python" and "/" in words[1]:
            assert (ROOT / words[1]).exists()


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", text(page)):
        if not link.startswith("http"):
            assert ((ROOT / page).parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES)
def test_files_named_in_passing_exist(page: str) -> None:
    for name in re.findall(r"`((?:rpg|scripts|tests|benchmarks)/[\w/.]+)`", text(page)):
        assert (ROOT / name).exists() or name.startswith("benchmarks/output"), name


def test_every_page_is_in_the_navigation() -> None:
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    listed = re.findall(r"[\w/-]+\.md", str(config["nav"]))
    assert sorted(f"docs/{name}" for name in listed) == [p for p in PAGES if p.startswith("docs/")]


@pytest.mark.parametrize(
    ("page", "schema"),
    [
        *(
            ("docs/agents.md", schema)
            for schema in (RPGConfig, LatentConfig, PolicyConfig, CEMConfig, PriorConfig, WorldModelConfig)
        ),
        ("docs/environments.md", EnvConfig),
        *(("docs/baselines.md", schema) for schema in (SACConfig, TDMPCConfig, PlannerConfig)),
        *(("docs/goal_agents.md", schema) for schema in (GoalDDPGConfig, GoalDQNConfig, HindsightConfig)),
        ("docs/exploration.md", RNDConfig),
        ("docs/exploration.md", Plan2ExploreConfig),
    ],
)
def test_every_setting_is_in_its_table(page: str, schema: type) -> None:
    first_cells = "\n".join(re.findall(r"^\| (.*?) \|", text(page), re.MULTILINE))
    described = {name.split(".")[-1] for name in re.findall(r"`([\w.]+)`", first_cells)}
    assert {field.name for field in dataclasses.fields(schema)} - described == set()


def test_every_variant_of_the_maze_experiment_is_described(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))  # as when it is run
    variants = runpy.run_path(str(ROOT / "scripts" / "maze_coverage.py"))["VARIANTS"]
    page = text("docs/maze.md")
    assert [name for name in variants if f"`{name}`" not in page and name not in ("rpg", "mbsac")] == []
