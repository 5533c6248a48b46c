"""Sections of the metrics, and the range in which a healthy run has them: what pages group, search and mark by.

The section of a metric follows from its group, the part of its name before "/"; the limits of `NORMAL` are measured,
or zero by construction, and each has its source.
"""

from __future__ import annotations

import dataclasses

from kinetix_dist.telemetry.names import METRICS

OTHER = "Other"

# Title of a section -> the groups of `telemetry.names` in it, in the order in which pages show them.
SECTIONS: dict[str, tuple[str, ...]] = {
    "Learning": ("evaluation", "train", "learner"),
    "Curriculum": ("curriculum",),
    "Speed": ("progress", "time"),
    "Processes": ("runtime", "copies", "telemetry"),
    "Physics": ("physics",),
    "Memory": ("memory",),
    OTHER: (),  # groups of plugins
}

_SECTION_OF_GROUP = {group: section for section, groups in SECTIONS.items() for group in groups}


@dataclasses.dataclass(frozen=True)
class Normal:
    """Values of a healthy run: from 0 to `high`. `source`: where the limit comes from, in one sentence."""

    high: float
    source: str


_NEVER = Normal(0.0, "each one is a fault (docs/operating.md)")

# Of metrics that alarm, or reassure, by their size alone. Others depend on recipe and machine.
NORMAL: dict[str, Normal] = {
    **{name: _NEVER for name in METRICS if name.startswith("physics/") and name != "physics/speed_limited"},
    "physics/speed_limited": Normal(
        100_000.0,
        "mostly the limit of spin, 50 rad/s; 1 k to 15 k measured, 40 k seen (docs/dashboard.md)",
    ),
    "learner/skipped_steps": _NEVER,
    "learner/skipped_updates": _NEVER,
    "runtime/dropped_steps": _NEVER,
    "runtime/restarts": _NEVER,
    "telemetry/dropped_rows": _NEVER,
    "telemetry/dropped_writes": _NEVER,
}


def section_of(name: str) -> str:
    """Title of the section of a metric; `OTHER` for groups that no section names."""
    return _SECTION_OF_GROUP.get(name.split("/")[0], OTHER)
