"""Whether processes are alive, and making sure that dead ones are gone.

A process counts as lost when Ray says that it died, or when it has not answered a ping for `heartbeat_seconds` (a
stopped or hung process does not exit). The remedy is always the same: kill the whole group, see that every process is
gone, start afresh from a checkpoint.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from typing import Any

import ray

from kinetix_dist.runtime.processes.failures import ProcessFailedError, WorkerLostError

POLL_S = 1.0
PING_EVERY_S = 5.0
FAILURE_GRACE_S = 3.0  # for the process that failed to say so, after another has lost it
GONE_TIMEOUT_S = 30.0  # for the kernel to end a killed process, GPU memory included


class Heartbeats:
    """Pings a set of actors while somebody waits for their answers."""

    def __init__(self, heartbeat_seconds: float) -> None:
        self._limit_s = heartbeat_seconds
        self._pings: dict[Any, tuple[Any, float]] = {}  # actor -> (reference to its answer, when it was asked)

    def silent(self, actors: Sequence[Any]) -> list[Any]:
        """Actors whose oldest unanswered ping is too old. Asks again those that have answered."""
        now = time.monotonic()
        too_long = []
        for actor in actors:
            if actor not in self._pings:
                self._pings[actor] = (actor.ping.remote(), now)
                continue
            answer, asked = self._pings[actor]
            if ray.wait([answer], timeout=0)[0]:
                if now - asked >= PING_EVERY_S:
                    self._pings[actor] = (actor.ping.remote(), now)
            elif now - asked > self._limit_s:
                too_long.append(actor)
        return too_long

    def forget(self, actors: Sequence[Any]) -> None:
        for actor in actors:
            self._pings.pop(actor, None)


def gather(references: Sequence[Any], actors: Sequence[Any], heartbeats: Heartbeats) -> list[Any]:
    """Results in order. Raises WorkerLostError as soon as a process died or has been silent for too long, and
    ProcessFailedError as soon as one failed at its work."""
    waiting = list(references)
    while waiting:
        ready, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=POLL_S)
        for reference in ready:
            try:
                _result(reference)  # a loss shows at once, while the rest of the group may hang in a collective
            except WorkerLostError:
                _raise_failure_among([other for other in references if other is not reference])
                raise
        if waiting and (silent := heartbeats.silent(actors)):
            raise WorkerLostError(f"{len(silent)} of {len(actors)} processes stopped answering")
    return [_result(reference) for reference in references]


def wait_until_gone(pids: Sequence[int]) -> list[int]:
    """Polls until the processes have ended; returns those that have not in time (or run on another host)."""
    deadline = time.monotonic() + GONE_TIMEOUT_S
    left = list(pids)
    while left and time.monotonic() < deadline:
        left = [pid for pid in left if _exists(pid)]
        time.sleep(0.05 if left else 0.0)
    return left


def _result(reference: Any) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayActorError as error:
        raise WorkerLostError(f"a process died: {' '.join(str(error).split())[:200]}") from error
    except ray.exceptions.RayTaskError as error:
        failure = error.cause
        if not isinstance(failure, ProcessFailedError):  # before its own methods were reached
            raise ProcessFailedError("a process", f"failed: {type(failure).__name__}: {failure}", str(error)) from None
        if failure.is_loss_of_group:
            raise WorkerLostError(f"{failure.process} lost its group in a collective") from None
        raise failure from None


def _raise_failure_among(references: Sequence[Any]) -> None:
    """A process that fails takes its group along; whichever is heard of first, the failure is what has to be told."""
    if not references:
        return
    ready, _ = ray.wait(list(references), num_returns=len(references), timeout=FAILURE_GRACE_S)
    for reference in ready:
        with contextlib.suppress(WorkerLostError):
            _result(reference)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    # A zombie holds no memory and no GPU: its parent has yet to collect it.
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
