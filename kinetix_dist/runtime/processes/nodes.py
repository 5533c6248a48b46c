"""Asking every node of a cluster the same question, each in a new process of its own."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from kinetix_dist.runtime.processes.placement import PlacementError

ANSWER_TIMEOUT_S = 90.0  # for a node to start a process


def ask_nodes(task: Callable[..., Any], *arguments: Any) -> list[tuple[str, Any]]:
    """(name, what `task(*arguments)` returned there) of every node that is alive.

    task: a function that stands alone; it is sent by value, whatever code a node has. Raises PlacementError where a
    node does not answer. Ray is connected to already.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    module = sys.modules[task.__module__]
    ray.cloudpickle.register_pickle_by_value(module)
    try:
        # One call a process: it sees what is installed now, and leaves nothing behind.
        remote = ray.remote(num_cpus=0, max_retries=0, max_calls=1)(task)
        asked = {}
        for node in ray.nodes():
            if node["Alive"]:
                where = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                asked[remote.options(scheduling_strategy=where).remote(*arguments)] = _name(node)
    finally:
        ray.cloudpickle.unregister_pickle_by_value(module)
    _, silent = ray.wait(list(asked), num_returns=len(asked), timeout=ANSWER_TIMEOUT_S)
    if silent:
        names = ", ".join(asked[reference] for reference in silent[:3])
        raise PlacementError(f"{names} did not start a process within {ANSWER_TIMEOUT_S:g} s; see `ray status`")
    return [(name, _answer(reference, name)) for reference, name in asked.items()]


def _answer(reference: Any, name: str) -> Any:
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        reason = " ".join(str(error).split())[:200]
        raise PlacementError(f"{name} cannot run a task: {reason}; see its Ray logs") from None


def _name(node: dict[str, Any]) -> str:
    return f"node {node['NodeManagerHostname']} ({node['NodeManagerAddress']}, {node['NodeID'][:8]})"
