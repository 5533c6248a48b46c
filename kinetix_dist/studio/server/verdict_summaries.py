"""Verdicts for the table of runs: worked out one run after another, while somebody looks at the table.

    table of runs --of(rows)--> what is known; a task judges runs that are not known, or whose files have changed

The table never waits for a verdict. A run that goes on is judged again after SECONDS, or a multiple of what the last
verdict took, so that long runs cost no more.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.processes import Processes
from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.studio.runs.statements import UNKNOWN
from kinetix_dist.studio.runs.verdict import verdict_of

LOG = logging.getLogger(__name__)
SECONDS = 60.0  # between verdicts on a run that goes on
COST = 50  # or so many times what the last one took: 2 % of a core
FILES = (run_files.METRICS, run_files.EVALUATION_LINES, run_files.OUTCOMES, run_files.STATUS, run_files.CURRICULUM)

Summary = Mapping[str, Any]  # of `Verdict.summary`
NO_VERDICT = {
    "outcome": "bug",
    "rank": -1,
    "state": UNKNOWN,
    "heading": "a bug in the server; its console has the traceback",
}


def summary_of(path: Path) -> Summary:
    """Summary of the verdict on a run, whose files are read for it alone."""
    reader = RunReader(path)
    reader.read_first(lambda bytes_left: None)
    return verdict_of(reader, Refreshes(path), Processes(path)).summary()


@dataclasses.dataclass(frozen=True)
class _Judged:
    stamp: tuple[Any, ...]  # of the files that it was judged by
    summary: Summary
    again_at: float  # monotonic s


class VerdictSummaries:
    """Verdicts by run directory. `of` is called in the event loop."""

    def __init__(self, judge: Callable[[Path], Summary] = summary_of) -> None:
        self._judge = judge
        self._judged: dict[Path, _Judged] = {}
        self._waiting: dict[Path, tuple[Any, ...]] = {}
        self._current: Path | None = None  # that is being judged
        self._task: asyncio.Task[None] | None = None

    async def of(self, rows: Sequence[Mapping[str, Any]]) -> list[Summary | None]:
        """What is known of the runs of a table (rows of `run_index.summary`); None: not judged yet."""
        stamps = await asyncio.to_thread(lambda: [(Path(row["path"]), _stamp(row)) for row in rows])
        now = time.monotonic()
        found = [(path, stamp, self._judged.get(path)) for path, stamp in stamps]
        self._waiting = {
            path: stamp
            for path, stamp, one in found
            if path != self._current and (one is None or (one.stamp != stamp and one.again_at <= now))
        }
        if self._waiting and (self._task is None or self._task.done()):
            self._task = asyncio.create_task(self._work())
        return [one.summary if one is not None else None for _, _, one in found]

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    async def _work(self) -> None:
        while self._waiting:
            path = self._current = next(iter(self._waiting))
            stamp = self._waiting.pop(path)
            started = time.monotonic()
            try:
                summary = await asyncio.to_thread(self._judge, path)
            except Exception:
                LOG.exception("no verdict on %s", path)
                summary = NO_VERDICT
            ended = time.monotonic()
            self._current = None
            self._judged[path] = _Judged(stamp, summary, ended + max(SECONDS, COST * (ended - started)))


def _stamp(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """State of a run, which changes with time too, and times and sizes of its files."""
    path = Path(row["path"])
    return (row["status"]["state"], *((run_files.modified_at(path / n), run_files.size_of(path / n)) for n in FILES))
