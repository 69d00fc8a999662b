"""What a run leaves behind: ``metrics.jsonl`` and ``progress.csv`` always, TensorBoard and W&B as plug-ins.

A row is a flat dict. It carries the four counters ``decisions``, ``env_steps``, ``updates`` and ``wall_s``
(seconds), and metrics named ``train/...``, ``eval/...``, ``loss/...`` or ``time/...``. Non-finite numbers are
written as the strings ``"nan"``, ``"inf"`` and ``"-inf"``, because JSON has no such numbers;
:func:`read_rows` turns them back. The JSONL file is the record; the CSV is a view of it, with one column per
key ever seen, and is rebuilt whenever a new key appears or a run is opened again.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rpg.errors import RPGError, require_extra

Scalar: TypeAlias = float | int | str
Row: TypeAlias = dict[str, Scalar]
Picture: TypeAlias = NDArray[np.uint8]

COUNTERS = ("decisions", "env_steps", "updates", "wall_s")
_NON_FINITE = ("nan", "inf", "-inf")
_NUMBERED_PICTURE = re.compile(r"(?P<name>.+)_(?P<step>\d{9,})")


class Sink(Protocol):
    """Somewhere else to send what is logged. ``step`` is the number of environment steps."""

    def log(self, row: Row, step: int) -> None:
        """Take in one row, counters included; non-finite numbers arrive as floats."""

    def picture(self, name: str, rgb: Picture, step: int) -> None:
        """Take in an image, uint8 (H, W, 3)."""

    def rewind(self, env_steps: int) -> None:
        """Forget what was logged after ``env_steps``, as far as the sink can."""

    def close(self) -> None:
        """Hand over everything that is still held back."""


class Loggers:
    """Writes rows and pictures into ``run_dir`` and hands them to the sinks.

    Opening a folder that already has a log repairs what a killed process left half-written and appends to
    it. A failed write (full disk, no permission) raises :class:`RPGError` and leaves the files as they were.

    Args:
        run_dir: the run folder; made if missing.
        sinks: further destinations, in order.
    """

    def __init__(self, run_dir: Path, sinks: Sequence[Sink] = ()) -> None:
        self._sinks = tuple(sinks)
        self._pictures = run_dir / "pictures"
        self._jsonl = run_dir / "metrics.jsonl"
        self._csv = run_dir / "progress.csv"
        self._columns: tuple[str, ...] = ()
        with _one_line_errors(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
        if self._jsonl.exists():
            self._rewrite(read_rows(self._jsonl))

    def log(self, row: Mapping[str, Scalar], step: int) -> None:
        """Append one row.

        Args:
            row: counters and metrics; numpy numbers and 0-d tensors are read out.
            step: the x coordinate for the sinks, the number of environment steps.

        Raises:
            ValueError: a counter is missing or a value is neither a number nor a string.
            RPGError: the disk refused; the files still hold whole rows only.
        """
        clean = {key: _scalar(key, value) for key, value in row.items()}
        missing = [key for key in COUNTERS if key not in clean]
        if missing:
            raise ValueError(f"log row without {', '.join(missing)}; every row carries {', '.join(COUNTERS)}")
        _append(self._jsonl, _json_line(clean))
        if set(clean) <= set(self._columns):
            _append(self._csv, _csv_lines([clean], self._columns))
        else:
            self._rewrite_csv(read_rows(self._jsonl))
        for sink in self._sinks:
            sink.log(clean, step)

    def picture(self, name: str, rgb: Picture, step: int) -> None:
        """Save an image as ``pictures/<name>.png`` (the latest) and ``pictures/<name>_<step>.png``.

        Args:
            name: such as ``visits`` or ``eval/episode``; a slash becomes an underscore in the file name.
            rgb: uint8 (H, W, 3).
            step: the number of environment steps.
        """
        import imageio.v3 as imageio

        if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
            raise ValueError(
                f"picture {name!r} has shape {rgb.shape} and type {rgb.dtype}, need uint8 (H, W, 3)"
            )
        data = imageio.imwrite("<bytes>", rgb, extension=".png")
        stem = name.replace("/", "_")
        write_atomic(self._pictures / f"{stem}_{step:09d}.png", data)
        write_atomic(self._pictures / f"{stem}.png", data)
        for sink in self._sinks:
            sink.picture(name, rgb, step)

    def rewind(self, env_steps: int) -> None:
        """Drop every row and picture later than ``env_steps``, where the checkpoint being resumed was taken.

        Without this, what a crashed process logged after its last checkpoint would appear twice.
        """
        if self._jsonl.exists():
            self._rewrite([row for row in read_rows(self._jsonl) if float(row["env_steps"]) <= env_steps])
        with _one_line_errors(self._pictures):
            self._rewind_pictures(env_steps)
        for sink in self._sinks:
            sink.rewind(env_steps)

    def close(self) -> None:
        """Close the sinks. The files need no closing: every row is on disk when :meth:`log` returns."""
        for sink in self._sinks:
            sink.close()

    def _rewrite(self, rows: list[Row]) -> None:
        write_atomic(self._jsonl, b"".join(_json_line(row) for row in rows))
        self._rewrite_csv(rows)

    def _rewrite_csv(self, rows: list[Row]) -> None:
        metrics = sorted({key for row in rows for key in row} - set(COUNTERS))
        columns = (*COUNTERS, *metrics)
        header = dict(zip(columns, columns, strict=True))
        write_atomic(self._csv, _csv_lines([header, *rows], columns))
        self._columns = columns

    def _rewind_pictures(self, env_steps: int) -> None:
        kept: dict[str, dict[int, Path]] = {}
        for path in self._pictures.glob("*.png"):
            if match := _NUMBERED_PICTURE.fullmatch(path.stem):
                kept.setdefault(match["name"], {})[int(match["step"])] = path
        for name, by_step in kept.items():
            late = [step for step in by_step if step > env_steps]
            for step in late:
                by_step.pop(step).unlink()
            latest = self._pictures / f"{name}.png"
            if late and by_step:
                write_atomic(latest, by_step[max(by_step)].read_bytes())
            elif late:
                latest.unlink(missing_ok=True)


class TensorBoardSink:
    """Event files in ``<run_dir>/tensorboard``; on a rewind the viewer is told to purge what came after."""

    def __init__(self, run_dir: Path) -> None:
        self._dir = run_dir / "tensorboard"
        self._purge_step: int | None = None
        self._writer: Any = None

    def log(self, row: Row, step: int) -> None:
        for key, value in row.items():
            if not isinstance(value, str):
                self._open().add_scalar(key, value, step)

    def picture(self, name: str, rgb: Picture, step: int) -> None:
        self._open().add_image(name, rgb, step, dataformats="HWC")

    def rewind(self, env_steps: int) -> None:
        self.close()
        self._purge_step = env_steps + 1  # TensorBoard forgets steps >= purge_step of earlier files

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _open(self) -> Any:
        # Made at the first use, so that a rewind before it is part of the file, and so that choosing
        # TensorBoard does not slow down the start of the program.
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter

            with _one_line_errors(self._dir):
                self._writer = SummaryWriter(str(self._dir), purge_step=self._purge_step)
        return self._writer


class WandbSink:
    """One Weights & Biases run per run folder, offline too (``WANDB_MODE=offline``, ``wandb sync`` later).

    The run id is kept in ``<run_dir>/wandb_id.txt``, so a resumed run continues its W&B run. W&B's history
    only grows: rows between the checkpoint and the crash stay there and come twice. ``env_steps`` is
    declared as the x axis of every metric, so they lie on top of each other.

    Args:
        run_dir: the run folder.
        project: W&B project.
        config: the resolved config, shown beside the run.
        name: display name; the name of the run folder by default.
    """

    def __init__(
        self,
        run_dir: Path,
        project: str = "rpg",
        config: Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> None:
        require_extra("wandb", "wandb", "logging to Weights & Biases")
        import wandb

        id_file = run_dir / "wandb_id.txt"
        if not id_file.exists():
            write_atomic(id_file, os.urandom(4).hex().encode())
        try:
            self._run = wandb.init(
                project=project,
                name=name or run_dir.name,
                id=id_file.read_text().strip(),
                dir=run_dir,
                config=dict(config or {}),
                resume="allow",
                settings=wandb.Settings(console="off"),  # else every refresh of the live line is uploaded
            )
        except wandb.Error as error:
            reason = " ".join(str(error).split())
            raise RPGError(
                f"W&B did not start ({reason}); run 'wandb login' or set WANDB_MODE=offline"
            ) from error
        self._run.define_metric("*", step_metric="env_steps")

    def log(self, row: Row, step: int) -> None:
        self._run.log(dict(row))

    def picture(self, name: str, rgb: Picture, step: int) -> None:
        import wandb

        self._run.log({name: wandb.Image(rgb), "env_steps": step})

    def rewind(self, env_steps: int) -> None:
        """Nothing: W&B cannot take rows back, see the class."""

    def close(self) -> None:
        self._run.finish()


def read_rows(path: Path) -> list[Row]:
    """Read ``metrics.jsonl``; a last line that was cut off in mid-write is left out.

    Raises:
        RPGError: the file cannot be read, or a line before the last is not a row.
    """
    with _one_line_errors(path, "read"):
        lines = path.read_bytes().splitlines()
    rows: list[Row] = []
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
            if not isinstance(row, dict) or "env_steps" not in row:
                raise ValueError("no env_steps")
        except ValueError as error:
            if number == len(lines):
                break
            raise RPGError(
                f"{path} line {number} is not a metrics row ({error}); delete that line"
            ) from error
        rows.append({key: float(value) if value in _NON_FINITE else value for key, value in row.items()})
    return rows


def write_atomic(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data`` so that a reader, or a crash at any moment, sees the old or the new whole.

    Makes the folder if needed. Raises :class:`RPGError` if the disk refuses; ``path`` is then as before.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with _one_line_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def _append(path: Path, data: bytes) -> None:
    """Append ``data`` whole or not at all."""
    with _one_line_errors(path), path.open("ab", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        try:
            written = 0
            while written < len(data):  # a disk that fills up first writes a part, then refuses
                written += file.write(data[written:])
        except OSError:
            file.truncate(size)
            raise


@contextmanager
def _one_line_errors(path: Path, verb: str = "write") -> Iterator[None]:
    try:
        yield
    except OSError as error:
        name = errno.errorcode.get(error.errno or 0, "OSError")
        raise RPGError(
            f"cannot {verb} {path}: {error.strerror or error} ({name});"
            " make room or give permission, then start the same command again"
        ) from error


def _scalar(key: str, value: Any) -> Scalar:
    if hasattr(value, "item"):
        value = value.item()
    if not isinstance(value, float | int | str):
        raise ValueError(f"cannot log {key!r}: {type(value).__name__} is neither a number nor a string")
    return value


def _json_line(row: Row) -> bytes:
    return (json.dumps({key: _writable(value) for key, value in row.items()}) + "\n").encode()


def _csv_lines(rows: Sequence[Mapping[str, Scalar]], columns: Sequence[str]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writerows({key: _writable(value) for key, value in row.items()} for row in rows)
    return text.getvalue().encode()


def _writable(value: Scalar) -> Scalar:
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
