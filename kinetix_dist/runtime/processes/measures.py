"""What every process of a run measures of itself: how busy it is, what it compiled, its memory, what it moved.

    process:  Meter --Reading-->  backend (asks after every update, and never waits)  --summary()-->  metrics

A reading is taken in a thread of its own while a call runs, so it costs the call nothing.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections import defaultdict
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from typing import Any

from kinetix_dist.runtime.processes.gpu_use import gpu_used_share, pool_peak_share
from kinetix_dist.telemetry.compile_time import compile_seconds
from kinetix_dist.telemetry.sizes import bytes_of

GIB, MIB = 1 << 30, 1 << 20


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """Of one process, at one time."""

    role: str
    at: float  # s, time.monotonic() of that process
    busy_seconds: float  # in calls so far, the one that runs included
    compile_seconds: float
    moved_bytes: int  # arguments of calls and answers so far
    resident_bytes: int  # of host memory
    host_share: float  # of the memory of its host, by all programs
    gpu_share: float | None  # of the memory of its GPU, by all programs; None on a CPU
    pool_share: float | None  # the most that was in use of XLA's pool


class Meter:
    """Counts in one process. `calling` is for the thread that works, `read` for any."""

    def __init__(self, role: str) -> None:
        self._role = role
        self._busy = 0.0
        self._since: float | None = None
        self._moved = 0

    @contextmanager
    def calling(self) -> Generator[None]:
        """Around a call."""
        self._since = time.monotonic()
        try:
            yield
        finally:
            self._busy, self._since = self._busy + time.monotonic() - self._since, None

    def moved(self, *values: Any) -> None:
        """Arguments or an answer, which cross between processes: arrays in nested containers are counted."""
        self._moved += bytes_of(values)

    def read(self, *, has_device: bool) -> Reading:
        """has_device: whether JAX has started in this process; asking it would start it."""
        import psutil

        now, since = time.monotonic(), self._since
        return Reading(
            role=self._role,
            at=now,
            busy_seconds=self._busy + (0.0 if since is None else now - since),
            compile_seconds=compile_seconds(),
            moved_bytes=self._moved,
            resident_bytes=psutil.Process(os.getpid()).memory_info().rss,
            host_share=psutil.virtual_memory().percent / 100,
            gpu_share=gpu_used_share() if has_device else None,
            pool_share=pool_peak_share() if has_device else None,
        )


def summary(readings: Iterable[tuple[Reading | None, Reading]]) -> dict[str, float]:
    """Metrics from (the reading before, the last one) of every process; the one before is None for a new process."""
    by_role: dict[str, list[tuple[Reading | None, Reading]]] = defaultdict(list)
    for before, last in readings:
        by_role[last.role].append((before, last))
    metrics: dict[str, float] = {}
    for role, pairs in by_role.items():
        metrics[f"memory/resident_gib_{role}"] = max(last.resident_bytes for _, last in pairs) / GIB
        metrics[f"runtime/moved_mib_{role}"] = sum(last.moved_bytes for _, last in pairs) / MIB
        idle = [_idle(before, last) for before, last in pairs if before is not None and last.at > before.at]
        if idle:
            metrics[f"runtime/idle_{role}"] = sum(idle) / len(idle)
    last = [reading for pairs in by_role.values() for _, reading in pairs]
    for name, values in (
        ("runtime/compile_seconds", [reading.compile_seconds for reading in last]),
        ("memory/host_share", [reading.host_share for reading in last]),
        ("memory/gpu_share", [reading.gpu_share for reading in last if reading.gpu_share is not None]),
        ("memory/pool_share", [reading.pool_share for reading in last if reading.pool_share is not None]),
    ):
        if values:
            metrics[name] = max(values)
    return metrics


def _idle(before: Reading, last: Reading) -> float:
    """Share of the time between two readings that was spent in no call."""
    return 1.0 - (last.busy_seconds - before.busy_seconds) / (last.at - before.at)
