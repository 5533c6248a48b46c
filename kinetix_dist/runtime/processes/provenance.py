"""Code and versions that compute: of this process, of a checkpoint, and of all nodes of a cluster.

A run that is resumed elsewhere goes on, but its numbers are no longer bit for bit those of the unbroken run: other
versions compile other programs, and another number of devices adds up in another order.

Before a run starts on a cluster, its nodes have to agree on code, versions and the shared directory. A task on every
node is sent by value and does without this project's code there: a node with other code, or with none, answers too.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import platform
import secrets
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.installation import version_of
from kinetix_dist.runtime.processes.placement import PlacementError

_PACKAGES = ("kinetix-dist", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "warp-lang", "ray", "numpy")
_COMPUTE_NOTHING = ("orbax-checkpoint", "ray")
# Placements "local" and "colocated" run the same programs: same bits (split has another config hash).
_MAKES_NO_DIFFERENCE = ("placement",)


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python, of the packages that a run uses, and of the engine."""
    found = {"python": platform.python_version(), "engine": engine_revision()}
    return found | {name: version_of(name) for name in _PACKAGES}


@functools.cache
def engine_revision() -> str:
    """12 hexadecimal digits over the sources of the engine: the version of a checkout says little about its code."""
    return _revision("jax2d")


@functools.cache
def versions_and_code() -> dict[str, str]:
    """`versions`, and the same digits for the rest of the code: what all nodes of a run have to agree on."""
    return {**versions(), "code": _revision("kinetix_dist")}


def _revision(package: str) -> str:
    """Over the sources of a package, which is found without importing it."""
    found = importlib.util.find_spec(package)
    assert found is not None and found.origin is not None
    root = Path(found.origin).parent
    digest = hashlib.sha256()
    for path in sorted((*root.rglob("*.py"), *root.rglob("*.h"))):
        digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def what_differs(description: Mapping[str, Any], topology: Mapping[str, Any]) -> list[str]:
    """Differences between what computes now and what made the checkpoint so described: "devices 2 instead of 4".

    Most telling first. Empty where the same devices and versions go on, and for checkpoints without this record.
    """
    now = {name: version for name, version in versions().items() if name not in _COMPUTE_NOTHING}
    pairs = ((topology, description.get("topology", {})), (now, description.get("versions", {})))
    return [
        f"{name} {ours[name]} instead of {theirs[name]}"
        for ours, theirs in pairs
        for name in ours
        if name in theirs and name not in _MAKES_NO_DIFFERENCE and ours[name] != theirs[name]
    ]


MAX_NAMED = 3  # differences, nodes: a line stays a line


@dataclasses.dataclass(frozen=True)
class Answer:
    """Answer of one node."""

    node: str  # host name and address
    found: dict[str, Any]  # what `_look` returned there


def check_nodes(shared: Path) -> None:
    """Raises PlacementError where a node of the cluster has other code or versions than this process, or does not see
    what this process writes into the directory `shared`."""
    with _mark(shared) as mark:
        here = _look(str(mark))
        answers = [Answer(node, found) for node, found in query_nodes(_look, str(mark))]
    _check_versions(here, answers)
    if blind := [answer.node for answer in answers if not answer.found["sees_mark"]]:
        raise PlacementError(
            f"the run directory {shared} is not shared: {_some(blind)} cannot see what {here['host']} writes there; "
            "give --run a directory on a file system that all nodes mount at the same path"
        )


def _check_versions(here: dict[str, Any], answers: Sequence[Answer]) -> None:
    for answer in answers:
        theirs = answer.found
        if "error" in theirs:
            raise PlacementError(f"{answer.node} cannot run kinetix-dist: {theirs['error']}; {_REMEDY}")
        ours = here["versions"]
        differ = [
            f"{name} {theirs['versions'].get(name, 'unknown')} there and {ours[name]} here"
            for name in ours
            if theirs["versions"].get(name) != ours[name]
        ]
        if differ:
            raise PlacementError(f"{answer.node} differs from the driver's {here['host']}: {_some(differ)}; {_REMEDY}")


_REMEDY = "give all nodes the same checkout and `make install` there (requirements.lock)"


def _some(names: Sequence[str]) -> str:
    left = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {left} more" if left > 0 else "")


@contextlib.contextmanager
def _mark(directory: Path) -> Generator[Path]:
    """A file that did not exist before, so that an old copy of the directory on a node is no proof."""
    path = directory.absolute() / f".shared-{secrets.token_hex(8)}"
    try:
        path.write_text("")
    except OSError as error:
        raise PlacementError(f"cannot write to run directory {directory}: {error.strerror}") from error
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def _look(mark: str) -> dict[str, Any]:
    """Facts of the node that this runs on. Stands alone: it is sent to nodes by value."""
    import os
    import socket
    import time

    found: dict[str, Any] = {"host": socket.gethostname()}
    directory = os.path.dirname(mark)
    try:
        from kinetix_dist.runtime.processes import provenance

        found["versions"] = provenance.versions_and_code()
    except Exception as error:  # of whatever is installed there
        found["error"] = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    deadline = time.monotonic() + 5.0  # a network file system may show a new file a little later
    while not (seen := os.path.exists(mark)) and time.monotonic() < deadline:
        if os.path.isdir(directory):
            os.scandir(directory).close()  # which has it look again
        time.sleep(0.2)
    found["sees_mark"] = seen
    return found


ANSWER_TIMEOUT_S = 90.0  # for a node to start a process


def query_nodes(task: Callable[..., Any], *arguments: Any) -> list[tuple[str, Any]]:
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
        calls = {}
        for node in ray.nodes():
            if node["Alive"]:
                where = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                calls[remote.options(scheduling_strategy=where).remote(*arguments)] = _name(node)
    finally:
        ray.cloudpickle.unregister_pickle_by_value(module)
    _, silent = ray.wait(list(calls), num_returns=len(calls), timeout=ANSWER_TIMEOUT_S)
    if silent:
        names = ", ".join(calls[reference] for reference in silent[:3])
        raise PlacementError(f"{names} did not start a process within {ANSWER_TIMEOUT_S:g} s; see `ray status`")
    return [(name, _answer(reference, name)) for reference, name in calls.items()]


def _answer(reference: Any, name: str) -> Any:
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        reason = " ".join(str(error).split())[:200]
        raise PlacementError(f"{name} cannot run a task: {reason}; see its Ray logs") from None


def _name(node: dict[str, Any]) -> str:
    return f"node {node['NodeManagerHostname']} ({node['NodeManagerAddress']}, {node['NodeID'][:8]})"
