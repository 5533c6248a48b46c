"""What a report says of a process: where it ran, and how much of its memory it used."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

from kinetix_dist.child_python import difference_of_imports
from kinetix_dist.runtime.processes.gpu_memory import MIB, Budget
from kinetix_dist.runtime.processes.placement import PlacementError


def whereabouts(budget: Budget | None) -> dict[str, Any]:
    """Of the process that calls this: process id, host, and the file that it writes its errors to; with a `budget` also
    its GPU and what it has of it."""
    where: dict[str, Any] = {"pid": os.getpid(), "host": socket.gethostname(), "log": _log_of_this_process()}
    if budget is not None:
        where["gpu"] = os.environ.get("CUDA_VISIBLE_DEVICES", "0")
        where["memory_mib"] = {"budget": budget.total_bytes // MIB, "reserve": budget.reserve_bytes // MIB}
    return where


def refuse_other_imports(process: str, where: dict[str, Any]) -> None:
    """Raises PlacementError where a process on this host imports packages from elsewhere than this one does. where:
    what it said of itself. Nodes of a cluster are compared by their versions (`runtime/driver/nodes.py`)."""
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
    facts = {"process": process, "device": device.device_kind, **whereabouts(budget)}
    statistics = (device.memory_stats() if device.platform == "gpu" else None) or {}
    measured = {"pool": statistics.get("bytes_limit"), "pool_peak": statistics.get("peak_bytes_in_use")}
    memory = {name: value // MIB for name, value in measured.items() if value is not None}
    return facts | ({"memory_mib": facts.get("memory_mib", {}) | memory} if memory else {})
