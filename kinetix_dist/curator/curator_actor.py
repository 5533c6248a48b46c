"""Scores levels, in a process of its own that never holds up the learner."""

from __future__ import annotations

import ray

from kinetix_dist.process_shell import ProcessShell


@ray.remote(concurrency_groups={"control": 1})
class CuratorActor(ProcessShell):
    """A `ProcessShell` as a Ray actor; pings are answered while a call runs."""

    @ray.method(concurrency_group="control")
    def ping(self) -> int:
        return super().ping()
