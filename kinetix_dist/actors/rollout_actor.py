"""Plays: a process of the split placement that holds worlds and a copy of the policy, and ships trajectories."""

from __future__ import annotations

import ray

from kinetix_dist.process_shell import ProcessShell


@ray.remote(concurrency_groups={"control": 1})
class RolloutActor(ProcessShell):
    """A `ProcessShell` as a Ray actor; pings are answered while a call runs."""

    @ray.method(concurrency_group="control")
    def ping(self) -> int:
        return super().ping()
