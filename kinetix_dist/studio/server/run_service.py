"""Shared readers of runs: each run is found, read and followed once, however many pages watch it.

    every second:  RunReader.poll (in a thread) of each run that a page watches --> its channels

A run is read when it is first requested. Polling looks at sizes only where nothing is new.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from kinetix_dist.studio.runs.run_index import RunIndex, summary
from kinetix_dist.studio.runs.run_reader import Changes, RunReader

POLL_SECONDS = 1.0
SCAN_SECONDS = 5.0  # between looks for new runs


class UnknownRunError(LookupError):
    """No run has that name (any more)."""


class Watcher(Protocol):
    """Subscriber to a run, such as the channel of a page. Neither method may wait."""

    def changed(self, run_id: str, reader: RunReader, changes: Changes) -> None: ...

    def read(self, run_id: str, bytes_left: int) -> None: ...


class RunService:
    """Readers of runs by id. All methods are called in the event loop; reading happens in threads."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Raises UserError for paths that hold no runs."""
        self.index = RunIndex(paths)
        self._readers: dict[str, RunReader] = {}
        self._first_reads: dict[str, asyncio.Task[None]] = {}
        self._watchers: dict[str, set[Watcher]] = {}
        self._scanned_at = time.monotonic()

    def path_of(self, run_id: str) -> Path:
        """Raises UnknownRunError."""
        if run_id not in self.index.runs:
            raise UnknownRunError(f"there is no run {run_id!r}; the page of runs lists those that are there")
        return self.index.runs[run_id]

    def add(self, path: Path) -> None:
        """Serves the runs below another directory, too. Raises UserError where it cannot be read."""
        self.index.add(path)

    async def id_of(self, path: Path) -> str | None:
        """Name in addresses of the run in a directory; None where it is no run."""
        await self._scan_now()
        return next((name for name, run in self.index.runs.items() if run.resolve() == path.resolve()), None)

    async def look_for(self, run_id: str) -> None:
        """Scans for a run that is not known yet: its page may be opened before the list of runs."""
        if run_id not in self.index.runs:
            await self._scan_now()

    async def summaries(self) -> list[dict[str, Any]]:
        """Summary of each run, see `run_index.summary`."""
        await self._scan()
        runs = dict(self.index.runs)
        return await asyncio.to_thread(lambda: [summary(name, path) for name, path in runs.items()])

    async def reader(self, run_id: str) -> RunReader:
        """The reader of a run, once all that is there is read. Raises UnknownRunError."""
        await self.look_for(run_id)
        path = self.path_of(run_id)
        if run_id not in self._readers:
            self._readers[run_id] = RunReader(path)
            self._first_reads[run_id] = asyncio.create_task(self._read_first(run_id))
        await asyncio.shield(self._first_reads[run_id])
        return self._readers[run_id]

    def watch(self, run_id: str, watcher: Watcher) -> None:
        self._watchers.setdefault(run_id, set()).add(watcher)

    def unwatch(self, watcher: Watcher, run_id: str | None = None) -> None:
        """run_id None: all runs."""
        for name in [run_id] if run_id is not None else list(self._watchers):
            self._watchers.get(name, set()).discard(watcher)

    async def follow(self) -> None:
        """Polls watched runs forever. A slow poll (a disk that hangs) delays the next poll, but no page."""
        while True:
            started = time.monotonic()
            for run_id in [name for name, watchers in self._watchers.items() if watchers]:
                if run_id in self._readers and self._first_reads[run_id].done():
                    await self._poll(run_id)
            await asyncio.sleep(max(POLL_SECONDS - (time.monotonic() - started), 0.1))

    async def _scan(self) -> None:
        if time.monotonic() - self._scanned_at > SCAN_SECONDS or not self.index.runs:
            await self._scan_now()

    async def _scan_now(self) -> None:
        self._scanned_at = time.monotonic()
        await asyncio.to_thread(self.index.scan)

    async def _read_first(self, run_id: str) -> None:
        loop = asyncio.get_running_loop()

        def report(bytes_left: int) -> None:
            for watcher in set(self._watchers.get(run_id, ())):
                watcher.read(run_id, bytes_left)

        def report_from_thread(bytes_left: int) -> None:
            loop.call_soon_threadsafe(report, bytes_left)

        await asyncio.to_thread(self._readers[run_id].read_first, report_from_thread)

    async def _poll(self, run_id: str) -> None:
        reader = self._readers[run_id]
        changes = await asyncio.to_thread(_poll, reader)
        if changes:
            for watcher in set(self._watchers[run_id]):
                watcher.changed(run_id, reader, changes)


def _poll(reader: RunReader) -> Changes:
    with reader.lock:
        return reader.poll()
