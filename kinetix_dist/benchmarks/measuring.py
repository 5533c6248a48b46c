"""Options, records and clocks that all benchmarks share. The JSON file is complete after every record."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax

from kinetix_dist.errors import user_errors
from kinetix_dist.json_text import json_text

Record = dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """Options of every benchmark."""

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
                file.open("ab").close()  # unlike `touch` this refuses a directory

    def add(self, *records: Record) -> None:
        self.records += records
        self.save()

    def replace(self, records: Iterable[Record]) -> None:
        """Replaces all records: for a benchmark whose every run changes several of them."""
        self.records = list(records)
        self.save()

    def fail(self, line: str) -> None:
        """One measurement failed; the others go on."""
        self.failures.append(line)

    def save(self) -> None:
        if self.file is not None:
            self.file.write_text(json_text(self.records, indent=1) + "\n")


def compute_clock(device: Any) -> Callable[[], float]:
    """Seconds of a launch on `device`: wall time on a GPU, the time of this process's processor on a CPU.

    A launch uses one core there, so processor time is what it would take with that core to itself: other jobs change
    it less.
    """
    return time.perf_counter if device.platform == "gpu" else time.process_time


def median_seconds(function: Callable[[], Any], repeats: int) -> float:
    """Median wall time of `repeats` calls, after one that is not counted (it may compile)."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)
