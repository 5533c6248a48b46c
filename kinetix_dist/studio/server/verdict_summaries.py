"""Verdicts for the table of runs: worked out one run after another, while somebody looks at the table.

    table of runs --of(rows)--> what is known; runs that are not, or whose files changed --> Judge, a process

The table never waits for a verdict. A run that goes on is judged again after SECONDS, or a multiple of what the last
verdict took, so that long runs cost no more.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.child_python import command_of
from kinetix_dist.json_text import json_text
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.statements import UNKNOWN

SECONDS = 60.0  # between verdicts on a run that goes on
COST = 50  # or so many times what the last one took: 2 % of a core
NICE = 10  # of the process, as the engine worker
FILES = (run_files.METRICS, run_files.EVALUATION_LINES, run_files.OUTCOMES, run_files.STATUS, run_files.CURRICULUM)
PROCESS = "kinetix_dist.studio.runs.verdict_process"

Summary = Mapping[str, Any]  # of `Verdict.summary`
NO_VERDICT = {
    "outcome": "bug",
    "rank": -1,
    "state": UNKNOWN,
    "heading": "a bug in the server; its console has the traceback",
}


class Judge:
    """Process that works out verdicts, started with the first one. It ends with the server."""

    def __init__(self, module: str = PROCESS) -> None:
        self._module = module
        self._process: asyncio.subprocess.Process | None = None

    async def summary(self, path: Path) -> Summary:
        """Summary of a run's verdict; NO_VERDICT where the process ended over it: the next run gets another."""
        if self._process is None:
            pipe = asyncio.subprocess.PIPE
            command = command_of("kinetix_dist.parent_death", os.getpid(), NICE, *command_of(self._module))
            self._process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json_text(str(path)).encode() + b"\n")
        line = await self._process.stdout.readline()
        if not line:
            await self.end()
            return NO_VERDICT
        return json.loads(line)

    async def end(self) -> None:
        """Ends the process, if there is one."""
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


@dataclasses.dataclass(frozen=True)
class _Judged:
    stamp: tuple[Any, ...]  # of the files that it was judged by
    summary: Summary
    again_at: float  # monotonic s


class VerdictSummaries:
    """Verdicts by run directory. All methods are called in the event loop."""

    def __init__(self, judge: Judge | None = None) -> None:
        self._judge = judge if judge is not None else Judge()
        self._judged: dict[Path, _Judged] = {}
        self._waiting: dict[Path, tuple[Any, ...]] = {}
        self._current: Path | None = None  # that is being judged
        self._task: asyncio.Task[None] | None = None

    async def of(self, rows: Sequence[Mapping[str, Any]]) -> list[Summary | None]:
        """Summaries of the runs of a table (rows of `run_index.summary`); None: not judged yet."""
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
        try:
            while self._waiting:
                path = self._current = next(iter(self._waiting))
                stamp = self._waiting.pop(path)
                started = time.monotonic()
                summary = await self._judge.summary(path)
                ended = time.monotonic()
                self._current = None
                self._judged[path] = _Judged(stamp, summary, ended + max(SECONDS, COST * (ended - started)))
        finally:
            await self._judge.end()


def _stamp(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """State of a run, which changes with time too, and times and sizes of its files."""
    path = Path(row["path"])
    return (row["status"]["state"], *((run_files.modified_at(path / n), run_files.size_of(path / n)) for n in FILES))
