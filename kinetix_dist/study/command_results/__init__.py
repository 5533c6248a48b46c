"""Results of studies of commands, by the kind that their file names: rows, sentences and a picture."""

from __future__ import annotations

from kinetix_dist.study.command_results import environment_speed, goal_following, specialists
from kinetix_dist.study.command_results.kind import Kind, Row, Written

RESULTS: dict[str, Kind] = {
    "environment_speed": environment_speed.EnvironmentSpeed(),
    "goal_following": goal_following.GoalFollowing(),
    "specialists": specialists.Specialists(),
}

__all__ = ["RESULTS", "Kind", "Row", "Written"]
