"""Rows of a long table that are kept as they are found."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from halfspace_sss.provenance import Json, naming, provenance, write_atomically


class KeptRows(dict[str, Json]):
    """Rows of a long table by name, as JSON values, in a file: the same run started again goes on after them.
    `path`: file of the rows, a line for each, after a line of what they depend on. `of`: what the rows depend on
    besides versions and commit; rows of something else are dropped."""

    def __init__(self, path: Path, of: Mapping[str, object]) -> None:
        told = provenance()
        head = json.dumps({**of, "versions": told["versions"], "commit": told["commit"]}, sort_keys=True)
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        super().__init__(_whole(lines[1:]) if lines[:1] == [head] else [])
        self._path, self._head, self._begun = path, head, False

    def __setitem__(self, name: str, row: object) -> None:
        """Add a row, here and in the file."""
        if not self._begun:
            lines = (self._head, *(json.dumps(item) for item in self.items()))
            write_atomically(self._path, "".join(f"{line}\n" for line in lines))
            self._begun = True
        super().__setitem__(name, row)
        with naming(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([name, row]) + "\n")

    def finish(self) -> None:
        """Remove the file: the table is written."""
        self._path.unlink(missing_ok=True)


def _whole(lines: list[str]) -> list[list[object]]:
    """Rows up to the first that was cut off."""
    rows = []
    for line in lines:
        try:
            rows.append(json.loads(line))
        except ValueError:
            break
    return rows
