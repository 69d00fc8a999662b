"""What a figure says of its budget: how much of the whole evaluation its runs are, and what is missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rpg.figures import short_count

_NAMED = 15  # missing curves that are named; of more only the number


def what_was_run(
    ends: Mapping[str, Sequence[int]], whole: Mapping[str, int], seeds: int, unit: str = "env steps"
) -> str:
    """A line for a figure, made of what its curves hold.

    Args:
        ends: by the name of a curve, where each of its runs ends. Curves beyond the whole evaluation count for nothing.
        whole: how long a run of each curve of the whole evaluation is.
        seeds: runs of each.
        unit: of the lengths.
    """
    held = {name: list(values) for name, values in ends.items() if values}
    done = sum(min(end, steps) for name, steps in whole.items() for end in held.get(name, [])[:seeds])
    share = done / (seeds * sum(whole.values()))
    missing = [name for name in whole if name not in held]
    if not held:
        return "nothing was run yet; dotted: published"
    lengths = [short_count(end) for end in sorted(end for each in held.values() for end in each)]
    counts = [str(count) for count in sorted(len(each) for each in held.values())]
    wanted = [short_count(steps) for steps in sorted(whole.values())]
    told = ", ".join(missing) if len(missing) <= _NAMED else f"{len(missing)} of {len(whole)} curves"
    return (
        f"{share:.0%} of the whole budget: {_span(lengths)} of {_span(wanted)} {unit}, {_span(counts)} of "
        f"{seeds} seeds (in brackets); dotted: published" + (f"; not run: {told}" if missing else "")
    )


def _span(values: Sequence[str]) -> str:
    return values[0] if values[0] == values[-1] else f"{values[0]} to {values[-1]}"
