"""Figures that a report adds up over all sessions of a run: seconds and physics steps.

Each checkpoint holds the sums until then. A report holds more: the evaluation and the recordings after the last
checkpoint. A run that goes on begins with the sums of the report that belongs to its checkpoint, or of the checkpoint.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

DESCRIPTION = "sessions"  # of checkpoint.json


@dataclasses.dataclass(frozen=True)
class SessionTotals:
    """Sums over the sessions before this one."""

    wall_seconds: float = 0.0
    seconds_by_role: Mapping[str, float] = dataclasses.field(default_factory=dict)
    physics: Mapping[str, int] = dataclasses.field(default_factory=dict)  # as PhysicsWatch.totals


def totals_before(report_path: Path, description: Mapping[str, Any]) -> SessionTotals:
    """Sums at a checkpoint that a run goes on from. description: of the checkpoint; those of earlier versions have
    training seconds only."""
    report = read_report(report_path)
    if report is not None and report["policy_updates"] == description["num_updates"]:
        physics = {name: count for name, count in report["physics"].items() if name != "settings"}
        return SessionTotals(report["wall_seconds"], report["seconds_by_role"], physics)
    stored = description.get(DESCRIPTION, {"wall_seconds": description["training_seconds"]})
    return SessionTotals(**stored)


def read_report(path: Path) -> dict[str, Any] | None:
    """The report of a run; None where it has none, or one that is no report."""
    try:
        report = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    needed = {"policy_updates": int, "env_steps": int, "training_seconds": float, "wall_seconds": float}
    needed |= {"seconds_by_role": dict, "physics": dict, "config_hash": str}
    is_whole = isinstance(report, dict) and all(isinstance(report.get(name), kind) for name, kind in needed.items())
    return report if is_whole else None
