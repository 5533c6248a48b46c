"""Measurements of a process: where it runs, how busy it is, what it compiled, its memory, what it moved.

    process:  Meter --Reading-->  backend (requests one after every update, never waits)  --summary()-->  metrics

A reading is taken in a thread of its own while a call runs, so it costs the call nothing.
"""

from __future__ import annotations

import dataclasses
import os
import socket
import time
from collections import defaultdict
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kinetix_dist.child_python import difference_of_imports
from kinetix_dist.program_cache import compile_seconds
from kinetix_dist.runtime.processes.gpu_memory import GIB, MIB, Budget, Pool, gpu_used_share, pool_use
from kinetix_dist.runtime.processes.placement import PlacementError
from kinetix_dist.telemetry.sizes import bytes_of

_POOL = (("", "used"), ("peak_", "peak"), ("limit_", "limit"))  # parts of names in processes.jsonl, fields of Pool


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """Measurements of one process at one time."""

    name: str  # of the process
    role: str
    pid: int
    host: str
    device: str | None  # "cpu" or "gpu" that it computes on; None where JAX has not started
    doing: str | None  # the call that it is in
    at: float  # s, time.monotonic() of that process
    busy_seconds: float  # in calls so far, the one that runs included
    compile_seconds: float
    moved_bytes: int  # arguments of calls and answers so far
    resident_bytes: int  # of host memory
    host_share: float  # of the memory of its host, by all programs
    gpu_share: float | None  # of the memory of its GPU, by all programs; None on a CPU
    pool: Pool | None  # XLA's; None on a CPU


class Meter:
    """Counts in one process. `calling` is for the thread that works, `read` for any."""

    def __init__(self, name: str, role: str) -> None:
        self._name = name
        self._role = role
        self._host = socket.gethostname()
        self._doing: str | None = None
        self._busy = 0.0
        self._since: float | None = None
        self._moved = 0

    @contextmanager
    def calling(self, method: str) -> Generator[None]:
        """Around a call."""
        self._doing, self._since = method, time.monotonic()
        try:
            yield
        finally:
            self._busy, self._since = self._busy + time.monotonic() - self._since, None
            self._doing = None

    def moved(self, *values: Any) -> None:
        """Arguments or an answer, which cross between processes: arrays in nested containers are counted."""
        self._moved += bytes_of(values)

    def read(self, *, has_device: bool) -> Reading:
        """has_device: whether JAX has started in this process; asking it would start it."""
        import jax
        import psutil

        now, since = time.monotonic(), self._since
        return Reading(
            name=self._name,
            role=self._role,
            pid=os.getpid(),
            host=self._host,
            device=jax.default_backend() if has_device else None,
            doing=self._doing,
            at=now,
            busy_seconds=self._busy + (0.0 if since is None else now - since),
            compile_seconds=compile_seconds(),
            moved_bytes=self._moved,
            resident_bytes=psutil.Process(os.getpid()).memory_info().rss,
            host_share=psutil.virtual_memory().percent / 100,
            gpu_share=gpu_used_share() if has_device else None,
            pool=pool_use() if has_device else None,
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
        ("memory/pool_share", [reading.pool.peak_share for reading in last if reading.pool is not None]),
    ):
        if values:
            metrics[name] = max(values)
    return metrics


def description(before: Reading | None, last: Reading, *, age_seconds: float) -> dict[str, Any]:
    """One process of a line of processes.jsonl, see docs/run_data.md; what it does not have is absent."""
    known = {
        "device": last.device,
        **({f"pool_{name}bytes": getattr(last.pool, field) for name, field in _POOL} if last.pool is not None else {}),
        "gpu_share": last.gpu_share,
        "busy": 1.0 - _idle(before, last) if before is not None and last.at > before.at else None,
        "doing": last.doing,
    }
    return {
        **{name: getattr(last, name) for name in ("name", "role", "pid", "host", "resident_bytes", "compile_seconds")},
        **{name: value for name, value in known.items() if value is not None},
        "age_seconds": age_seconds,
    }


def _idle(before: Reading, last: Reading) -> float:
    """Share of the time between two readings that was spent in no call."""
    return 1.0 - (last.busy_seconds - before.busy_seconds) / (last.at - before.at)


def whereabouts(budget: Budget | None) -> dict[str, Any]:
    """Location of the process that calls this: process id, host, and the file that it writes its errors to; with a
    `budget` also its GPU and how much of it."""
    where: dict[str, Any] = {"pid": os.getpid(), "host": socket.gethostname(), "log": _log_of_this_process()}
    if budget is not None:
        where["gpu"] = os.environ.get("CUDA_VISIBLE_DEVICES", "0")
        where["memory_mib"] = {"budget": budget.total_bytes // MIB, "reserve": budget.reserve_bytes // MIB}
    return where


def refuse_other_imports(process: str, where: dict[str, Any]) -> None:
    """Raises PlacementError where a process on this host imports packages from elsewhere than this one does. where:
    what it said of itself. Nodes of a cluster are compared by their versions (`runtime/processes/provenance.py`)."""
    if where["host"] == socket.gethostname() and (differ := difference_of_imports(where["imports"])):
        raise PlacementError(f"{process} imports {differ}; start the command in another directory, or unset PYTHONPATH")


def _log_of_this_process() -> str | None:
    """The file that standard error goes to; None where it is none, and on systems without /proc."""
    try:
        path = Path(os.readlink("/proc/self/fd/2"))
    except OSError:
        return None
    return str(path) if path.is_file() else None


def facts_of(process: str, budget: Budget | None) -> dict[str, Any]:
    """The same after it has computed, with the device and the most that it used of XLA's pool."""
    import jax

    device = jax.local_devices()[0]
    facts: dict[str, Any] = {"process": process, "device": device.device_kind, **whereabouts(budget)}
    statistics = (device.memory_stats() if device.platform == "gpu" else None) or {}
    measured = {"pool": statistics.get("bytes_limit"), "pool_peak": statistics.get("peak_bytes_in_use")}
    memory = {name: value // MIB for name, value in measured.items() if value is not None}
    return facts | ({"memory_mib": facts.get("memory_mib", {}) | memory} if memory else {})
