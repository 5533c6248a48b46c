"""What a report says of a process: where it ran, and how much of its memory it used."""

from __future__ import annotations

import os
import socket
from typing import Any

from kinetix_dist.runtime.processes.gpu_memory import MIB, Budget


def whereabouts(budget: Budget | None) -> dict[str, Any]:
    """Of the process that calls this: process id and host; with a `budget` also its GPU and what it has of it."""
    where: dict[str, Any] = {"pid": os.getpid(), "host": socket.gethostname()}
    if budget is not None:
        where["gpu"] = os.environ.get("CUDA_VISIBLE_DEVICES", "0")
        where["memory_mib"] = {"budget": budget.total_bytes // MIB, "reserve": budget.reserve_bytes // MIB}
    return where


def facts_of(process: str, budget: Budget | None) -> dict[str, Any]:
    """The same after it has computed, with the device and the most that it used of XLA's pool."""
    import jax

    device = jax.local_devices()[0]
    facts = {"process": process, "device": device.device_kind, **whereabouts(budget)}
    statistics = (device.memory_stats() if device.platform == "gpu" else None) or {}
    measured = {"pool": statistics.get("bytes_limit"), "pool_peak": statistics.get("peak_bytes_in_use")}
    memory = {name: value // MIB for name, value in measured.items() if value is not None}
    return facts | ({"memory_mib": facts.get("memory_mib", {}) | memory} if memory else {})
