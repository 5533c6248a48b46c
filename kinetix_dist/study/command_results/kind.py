"""Interface of the results of a command, by kind."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

Row = dict[str, Any]
RECORDS = "records.json"  # file of benchmarks, in the directory of a run


@dataclasses.dataclass(frozen=True, kw_only=True)
class Written:
    """Records that a run has written."""

    arm: str
    seed: int
    directory: Path


class Kind(Protocol):
    """Reader of one kind of results."""

    def rows(self, written: Sequence[Written]) -> list[Row]:
        """Rows of all runs, with "arm" and "seed". Raises OSError, ValueError for files that cannot be read."""
        ...

    def sentences(self, rows: Sequence[Row]) -> list[str]:
        """Findings, a sentence each."""
        ...

    def finding(self, rows: Sequence[Row]) -> str:
        """The same in one line, for `study list`."""
        ...

    def draw(self, question: str, rows: Sequence[Row], file: Path) -> None:
        """Writes the picture. Raises OSError."""
        ...


def records_of(written: Sequence[Written]) -> list[Row]:
    """Rows of the records of a benchmark."""
    return [
        {"arm": one.arm, "seed": one.seed} | record
        for one in written
        for record in json.loads((one.directory / RECORDS).read_text())
    ]
