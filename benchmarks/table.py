"""Rewrites the tables of benchmarks/README.md from the newest recorded lines.

python benchmarks/table.py
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from bench import HERE, OUTPUT, Line, recorded

from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.training.loggers import write_atomic

BEGIN, END = "<!-- tables: written by benchmarks/table.py -->", "<!-- end of tables -->"
# The published implementation with the same sizes on two such cores: docs/benchmarks.md.
REFERENCES = [
    ["published, no predictor step", "2 CPU cores", "", "float32", "no", "3.5", "", "", "", "", "", ""],
    ["published", "2 CPU cores", "", "float32", "no", "about 3.3", "", "13.3 to 16.2", "", "", "", ""],
]
PLASTICINE_REFERENCES = [
    ["public release, Move", "2 CPU cores", "2", "float64", "10,000", "215", "590", "330", "", "4,100", ""],
    ["thesis, Table 2.2, Move", "GTX 1080 Ti", "", "", "10,000", "14.3", "35.6", "", "", "", ""],
]
IDENTITY = ("name", "cpu", "threads", "dtype", "compile", "overrides", "fill")
DEFAULTS: Line = {"compile": False, "overrides": "", "fill": 0}  # of lines that do not say


def newest(lines: Iterable[Line]) -> list[Line]:
    """The last line of each that measured the same thing, in a fixed order."""
    last = {tuple(str((DEFAULTS | line)[key]) for key in IDENTITY): DEFAULTS | line for line in lines}
    return [last[key] for key in sorted(last)]


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table, or nothing without rows."""
    texts = [head, ["---"] * len(head), *rows] if rows else []
    return "\n".join("| " + " | ".join(cells) + " |" for cells in texts)


def number(value: float | None) -> str:
    """Three digits; empty for None."""
    return "" if value is None else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def yes(value: bool) -> str:
    """For a cell."""
    return "yes" if value else "no"


def what(line: Line) -> list[str]:
    """The cells that say what was measured."""
    special = " ".join([*([f"--fill={line['fill']}"] if line["fill"] else []), line["overrides"]]).strip()
    name = line["name"] + (f" `{special}`" if special else "")
    return [name, line["cpu"], str(line["threads"]), line["dtype"], yes(line["compile"])]


def learning(lines: list[Line]) -> str:
    """Learning, one row a line, after the published numbers."""
    head = (
        "name,on,threads,dtype,compiled,updates/s,times eager,env steps/s,GFLOP/update,share of matmul rate"
    )
    numbers = ("updates_per_s", "speedup", "env_steps_per_s", "gflop_per_update", "share", "peak_memory_mb")
    rows = [[*what(line), *(number(line.get(key)) for key in numbers), line["commit"]] for line in lines]
    return markdown([*head.split(","), "peak MB", "commit"], [*REFERENCES, *rows] if rows else [])


def acting(lines: list[Line]) -> str:
    """Acting, one row for each number of environments."""
    head = "name,on,threads,dtype,compiled,environments,decisions/s,eager,env steps/s collected,commit"
    numbers = ("num_envs", "decisions_per_s", "eager_decisions_per_s", "env_steps_per_s")
    rows = [
        [*what(line), *(number(point[key]) for key in numbers), line["commit"]]
        for line in lines
        for point in line["points"]
    ]
    return markdown(head.split(","), rows)


def replaying(lines: list[Line]) -> str:
    """Replay, one row for each combination."""
    head = "on,threads,environments,transitions,batch,vector steps stored/s,batches sampled/s,GB/s,share of a copy"
    numbers = (
        "num_envs",
        "fill",
        "batch_size",
        "adds_per_s",
        "samples_per_s",
        "sample_gb_per_s",
        "sample_share",
    )
    rows = [
        [line["cpu"], str(line["threads"]), *(number(point[key]) for key in numbers), line["commit"]]
        for line in lines
        for point in line["points"]
    ]
    return markdown([*head.split(","), "commit"], rows)


def threading(lines: list[Line]) -> str:
    """Threads, one row for each thread count and number of other processes."""
    head = "name,on,dtype,compiled,threads,other busy processes,updates/s,env steps/s,share of matmul rate"
    numbers = ("updates_per_s", "env_steps_per_s", "share")
    rows = [
        [
            line["name"], line["cpu"], line["dtype"], yes(line["compile"]), str(point["threads"]),
            str(point["others"]), *(number(point[key]) for key in numbers), line["commit"],
        ]
        for line in lines
        for point in line["points"]
    ]  # fmt: skip
    return markdown([*head.split(","), "commit"], rows)


def simulating(lines: list[Line]) -> str:
    """Soft bodies, one row a line, after the published numbers."""
    head = "name,on,threads,dtype,particles,ms a step,ms with gradient,s to first gradient cold,warm,peak MB,commit"
    numbers = ("particles", "forward_ms", "forward_backward_ms", "compile_s", "second_run_s", "peak_rss_mb")
    rows = [
        [
            line["name"], line["cpu"], str(line["threads"]), line["dtype"],
            *(number(line.get(key)) for key in numbers), line["commit"],
        ]
        for line in lines
    ]  # fmt: skip
    return markdown(head.split(","), [*PLASTICINE_REFERENCES, *rows] if rows else [])


def planning(lines: list[Line]) -> str:
    """Landmark maps, one row for each size, stepped for the most environments."""
    head = "name,on,threads,landmarks,choose ms,map s,plain loops s,ten states in s"
    head += ",environments,step ms,plain loops ms,new goals ms,commit"
    of_map = ("landmarks", "choose_ms", "build_s", "naive_build_s", "insert_s")
    of_step = ("num_envs", "step_ms", "naive_step_ms", "new_goals_ms")
    rows = [
        [
            line["name"], line["cpu"], str(line["threads"]), *(number(point.get(key)) for key in of_map),
            *(number(point["envs"][-1].get(key)) for key in of_step), line["commit"],
        ]
        for line in lines
        for point in line["points"]
    ]  # fmt: skip
    return markdown(head.split(","), rows)


def tables(folder: Path) -> str:
    """What stands between the markers, from the files of ``folder``."""
    lines = newest(
        line for path in sorted(folder.glob("*.jsonl")) for line in recorded(path) if "knob" not in line
    )
    parts = []
    for title, kind, write in (
        ("Learning", "learning/", learning),
        ("Acting", "act/", acting),
        ("Replay", "replay", replaying),
        ("Threads", "threads/", threading),
        ("Soft bodies", "plasticine/", simulating),
        ("Landmark maps", "planner/", planning),
    ):
        text = write([line for line in lines if line["name"].startswith(kind)])
        parts += [f"### {title}", text] if text else []
    return "\n\n".join(parts)


def main(argv: list[str] | None = None) -> None:
    """Rewrite the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder of the recorded lines")
    parser.add_argument("--page", type=Path, default=HERE / "README.md")
    with report_errors():
        args = parser.parse_args(argv)
        page = args.page.read_text() if args.page.exists() else ""
        before, begin, rest = page.partition(BEGIN)
        _, end, after = rest.partition(END)
        if not begin or not end:
            raise RPGError(f"{args.page}: needs the lines '{BEGIN}' and '{END}'; the tables go between them")
        write_atomic(args.page, f"{before}{BEGIN}\n\n{tables(args.output)}\n\n{END}{after}".encode())
        print(args.page)


if __name__ == "__main__":
    main()
