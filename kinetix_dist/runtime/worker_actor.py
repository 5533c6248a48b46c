"""Plays and learns: a process of the colocated placement, one a GPU, that holds worlds and a learner shard."""

from __future__ import annotations

import ray

from kinetix_dist.process_shell import ProcessShell


@ray.remote(concurrency_groups={"control": 1})
class WorkerActor(ProcessShell):
    """A `ProcessShell` as a Ray actor; pings are answered while a call runs."""

    @ray.method(concurrency_group="control")
    def ping(self) -> int:
        return super().ping()
