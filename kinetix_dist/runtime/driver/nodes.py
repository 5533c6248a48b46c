"""What the nodes of a cluster have to agree on before a run starts there: code, versions, and the shared directory.

Every node is asked by a task of its own, which does without this project's code there: a node with other code, or with
none, can be asked too.
"""

from __future__ import annotations

import contextlib
import dataclasses
import secrets
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.runtime.processes.nodes import ask_nodes
from kinetix_dist.runtime.processes.placement import PlacementError

MAX_NAMED = 3  # differences, nodes: a line stays a line


@dataclasses.dataclass(frozen=True)
class Answer:
    """Of one node."""

    node: str  # host name and address
    found: dict[str, Any]  # what `_look` returned there


def check_nodes(shared: Path) -> None:
    """Raises PlacementError where a node of the cluster has other code or versions than this process, or does not see
    what this process writes into the directory `shared`."""
    with _mark(shared) as mark:
        here = _look(str(mark))
        answers = [Answer(node, found) for node, found in ask_nodes(_look, str(mark))]
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
    """Of the node that this runs on. Stands alone: it is sent to nodes by value."""
    import os
    import socket
    import time

    found: dict[str, Any] = {"host": socket.gethostname()}
    directory = os.path.dirname(mark)
    try:
        from kinetix_dist.runtime.driver.provenance import versions_and_code

        found["versions"] = versions_and_code()
    except Exception as error:  # of whatever is installed there
        found["error"] = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    deadline = time.monotonic() + 5.0  # a network file system may show a new file a little later
    while not (seen := os.path.exists(mark)) and time.monotonic() < deadline:
        if os.path.isdir(directory):
            os.scandir(directory).close()  # which has it look again
        time.sleep(0.2)
    found["sees_mark"] = seen
    return found
