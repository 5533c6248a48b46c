"""What moving batches and weights cost in an update, and which rollout actor was the slowest (split placement)."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from kinetix_dist.runtime.processes.measures import MIB

Copied = Mapping[str, tuple[int, float]]  # {copy: (bytes, seconds)} of one process


def copy_metrics(processes: Sequence[Copied]) -> dict[str, float]:
    """MiB of all processes together and seconds of the one that took longest, by copy (`telemetry.names.COPIES`)."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(name for copied in processes for name in copied):
        of_all = [copied[name] for copied in processes if name in copied]
        found[f"copies/{name}_mib"] = sum(num_bytes for num_bytes, _ in of_all) / MIB
        found[f"copies/{name}_seconds"] = max(seconds for _, seconds in of_all)
    return found


def added(parts: Sequence[Copied]) -> dict[str, tuple[int, float]]:
    """Of one process, which copied several parts one after another."""
    names = dict.fromkeys(name for copied in parts for name in copied)
    of = {name: [copied[name] for copied in parts if name in copied] for name in names}
    return {name: (sum(size for size, _ in found), sum(s for _, s in found)) for name, found in of.items()}


def straggler_metrics(stamps: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The slowest rollout actor of a batch; nothing where there is one only. stamps: in the order of actors."""
    if len(stamps) < 2:
        return {}
    seconds = [stamp["seconds"] for stamp in stamps]
    slowest = seconds.index(max(seconds))
    others = statistics.median(seconds[:slowest] + seconds[slowest + 1 :])
    return {"runtime/slowest_actor": float(slowest), "runtime/slowest_actor_lag_seconds": seconds[slowest] - others}
