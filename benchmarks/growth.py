"""How speed and memory grow with batch, width, horizon, replay and number of environments.

    python benchmarks/growth.py                        # one knob at a time around size=fast, eager, one thread
    python benchmarks/growth.py --only batch,envs --again

Every point is ``learning.py`` in a process of its own. Points already in ``growth.jsonl`` are not measured
again unless ``--again``. Draws ``growth.png`` of every knob whose points are all there.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from bench import OUTPUT, apart, append, forwarded, options, recorded
from matplotlib.ticker import FuncFormatter, NullLocator

from rpg.cli import report_errors
from rpg.errors import RPGError, nearest
from rpg.figures import curve, legend, new_figure, save, short_count, style_axes

KNOBS: dict[str, tuple[str, list[int], list[str]]] = {  # label, values, what a value sets
    "batch": ("segments in a batch", [32, 64, 128, 256, 512], ["size.batch_size={}"]),
    "width": ("width of the networks", [32, 64, 128, 256, 512], ["size.width={}"]),
    "horizon": (
        "imagined and segment steps",
        [1, 2, 3, 5, 8],
        ["world_model.horizon={}", "agent.actor_horizon={}", "size.target_horizon={}"],
    ),
    "replay": (
        "transitions in replay, full",
        [10_000, 50_000, 200_000, 800_000],
        ["--fill={}", "trainer.replay_capacity={}"],
    ),
    "envs": ("environments", [1, 5, 20, 80], ["env.num_envs={}"]),
}


def command(args: argparse.Namespace, knob: str, value: int) -> list[str]:
    """The arguments of ``learning.py`` for a point."""
    set_to = [text.format(value) for text in KNOBS[knob][2]]
    flags = [text for text in set_to if text.startswith("--")]
    return [*flags, *forwarded(args, *(text for text in set_to if text not in flags))]


def measure(args: argparse.Namespace, path: Path) -> None:
    """Record what is missing."""
    known = [] if args.again else [line["command"] for line in recorded(path)]
    for knob in args.only:
        for value in KNOBS[knob][1]:
            words = command(args, knob, value)
            if words in known:
                continue
            line = apart("learning.py", words)
            line |= {"name": f"growth/{knob}", "knob": knob, "value": value, "command": words}
            append(path, json.dumps(line))
            print(
                f"{knob} {value}: {line['updates_per_s']} updates/s, {line['peak_memory_mb']} MB",
                file=sys.stderr,
            )


def draw(args: argparse.Namespace, path: Path) -> Path:
    """One column of panels for each complete knob, from the newest line of every point."""
    newest = {tuple(line["command"]): line for line in recorded(path)}
    points = {
        knob: [newest.get(tuple(command(args, knob, value))) for value in values]
        for knob, (_, values, _) in KNOBS.items()
    }
    complete = {knob: [line for line in lines if line] for knob, lines in points.items() if all(lines)}
    columns = len(complete)
    fig, axes = new_figure(2, columns, width=max(2.5, 4.5 / columns), height=2.3, sharey=True)
    most = 0.0
    for (knob, lines), speed, memory in zip(complete.items(), axes[:columns], axes[columns:], strict=True):
        label, values, _ = KNOBS[knob]
        for index, key in enumerate(("updates_per_s", "env_steps_per_s")):
            name = key.removesuffix("_per_s").replace("_", " ")
            curve(speed, values, [line[key] for line in lines], label=name, index=index)
        held = [line["peak_memory_mb"] for line in lines]
        curve(memory, values, held, index=2)
        most = max(most, *held)
        for ax in (speed, memory):
            ax.set_xscale("log")
            ax.set_xticks(values, [short_count(value) for value in values])
            ax.xaxis.set_minor_locator(NullLocator())
        style_axes(speed, title=knob)
        style_axes(memory, label)
    axes[0].set_yscale("log")  # a row shares its axis
    axes[0].yaxis.set_major_formatter(FuncFormatter(lambda value, _: short_count(value)))
    axes[0].yaxis.set_minor_locator(NullLocator())
    axes[0].set_ylabel("per second")
    axes[columns].set_ylabel("peak memory (MB)")
    axes[columns].set_ylim(0, 1.1 * most)
    legend(fig, axes[0])
    picture = path.with_suffix(".png")
    save(fig, picture, dpi=130)
    return picture


def main(argv: list[str] | None = None) -> None:
    """Measure what is missing and draw all."""
    parser = options(__doc__, size="fast", threads=1, repeats=5, compile=False, out=OUTPUT)
    parser.add_argument(
        "--only", type=lambda text: text.split(","), default=list(KNOBS), help=",".join(KNOBS)
    )
    parser.add_argument("--again", action="store_true", help="measure recorded points anew")
    with report_errors():
        args = parser.parse_args(argv)
        for knob in args.only:
            if knob not in KNOBS:
                raise RPGError(f"--only {knob}: no such knob; {nearest(knob, KNOBS)}")
        path = args.out / "growth.jsonl"
        measure(args, path)
        picture = draw(args, path)
        print(json.dumps({"name": "growth", "points": str(path), "picture": str(picture)}))


if __name__ == "__main__":
    main()
