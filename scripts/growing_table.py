"""A CSV that grows row by row, so that an experiment of many parts may stop and go on, with a JSON of what made it."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rpg.errors import RPGError
from rpg.provenance import provenance
from rpg.training.loggers import write_atomic


class Table:
    """Rows by key: one with a key that is there already replaces it.

    Args:
        path: of the CSV; the JSON stands beside it.
        columns: all of them.
        key: those that tell one row from another.

    Raises:
        RPGError: the file there has other columns.
    """

    def __init__(self, path: Path, columns: Sequence[str], key: Sequence[str]) -> None:
        self.path, self._columns, self._key = path, list(columns), list(key)
        self._rows: dict[tuple[str, ...], dict[str, str]] = {}
        self._origin = path.with_suffix(".json")
        self._runs: list[dict[str, Any]] = []
        if path.exists():
            with path.open(newline="") as file:
                reader = csv.DictReader(file)
                if reader.fieldnames != self._columns:
                    raise RPGError(f"{path}: made by another version of this script; move it away")
                self._rows = {self._key_of(row): row for row in reader}
        if self._origin.exists():
            self._runs = json.loads(self._origin.read_text())["runs"]
        self._added = 0

    @property
    def rows(self) -> list[dict[str, str]]:
        """All rows in the order in which their keys came."""
        return list(self._rows.values())

    def has(self, **key: Any) -> bool:
        """Whether there is a row with this key."""
        return self._key_of(key) in self._rows

    def add(self, **row: Any) -> None:
        """Add a row and write the file; columns not given stay empty, and others are left out."""
        self.extend([row])

    def extend(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Add rows and write the file once."""
        before = self._added
        for row in rows:
            texts = {name: _text(row.get(name, "")) for name in self._columns}
            self._rows[self._key_of(texts)] = texts
            self._added += 1
        if self._added > before:
            self._write(first=before == 0)

    def _write(self, first: bool) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_atomic(self.path, text.getvalue().encode())
        if first:
            self._runs.append(provenance())
        self._runs[-1]["rows"] = self._added
        write_atomic(self._origin, (json.dumps({"runs": self._runs}, indent=2) + "\n").encode())

    def _key_of(self, row: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(_text(row[name]) for name in self._key)


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
