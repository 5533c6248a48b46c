"""Where the records of a benchmark go: a list in memory, a JSON file that is complete after every record."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from kinetix_dist.errors import user_errors

Record = dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What every benchmark takes."""

    json: Path | None = None
    """Write the records here."""


class Results:
    """Records and failures of one benchmark so far. A long benchmark that is cut short leaves what it had measured."""

    def __init__(self, file: Path | None = None, report: Callable[[str], None] = lambda line: None) -> None:
        """`file`: JSON list of the records, or None; `report` gets lines for a person. Raises UserError for a file
        that cannot be written, before anything is measured."""
        self.file = file
        self.report = report
        self.records: list[Record] = []
        self.failures: list[str] = []
        if file is not None:
            with user_errors(OSError):
                file.parent.mkdir(parents=True, exist_ok=True)
                file.touch()

    def add(self, *records: Record) -> None:
        self.records += records
        self.save()

    def replace(self, records: Iterable[Record]) -> None:
        """Other records in the place of all: those of a benchmark whose every run changes what is known of several."""
        self.records = list(records)
        self.save()

    def fail(self, line: str) -> None:
        """One measurement failed; the others go on."""
        self.failures.append(line)

    def save(self) -> None:
        if self.file is not None:
            self.file.write_text(json.dumps(self.records, indent=1) + "\n")
