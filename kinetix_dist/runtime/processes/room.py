"""What a Ray cluster has room for: CPU slots and GPUs of the nodes that live, and those that nobody holds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import ray

from kinetix_dist.runtime.processes.placement import Placement


@dataclasses.dataclass(frozen=True)
class Room:
    """For processes: one CPU slot each, and GPUs."""

    cpus: int
    gpus: int

    def __add__(self, other: Room) -> Room:
        return Room(self.cpus + other.cpus, self.gpus + other.gpus)

    def at_most(self, other: Room) -> Room:
        return Room(min(self.cpus, other.cpus), min(self.gpus, other.gpus))

    def holds(self, needed: Room) -> bool:
        return self.cpus >= needed.cpus and self.gpus >= needed.gpus


def needed_by(placement: Placement) -> Room:
    gpus = {process.gpu for process in placement.processes if process.gpu is not None}
    return Room(len(placement.processes), len(gpus))


def total_room() -> Room:
    """Of all nodes that live."""
    return _room(ray.cluster_resources())


def free_room() -> Room:
    """Of that, what nobody holds."""
    return _room(ray.available_resources())


def nodes_in_words() -> str:
    """ "node-1 (8 CPU slots, 4 GPUs), node-2 (8 CPU slots, 4 GPUs), 1 lost" """
    nodes = ray.nodes()
    living = [f"{node['NodeManagerHostname']} ({_in_words(node['Resources'])})" for node in nodes if node["Alive"]]
    num_lost = len(nodes) - len(living)
    return ", ".join([*living, *([f"{num_lost} lost"] if num_lost else [])])


def _in_words(resources: Mapping[str, float]) -> str:
    room = _room(resources)
    return f"{room.cpus} CPU slots, {room.gpus} GPUs"


def _room(resources: Mapping[str, float]) -> Room:
    return Room(int(resources.get("CPU", 0)), int(resources.get("GPU", 0)))
