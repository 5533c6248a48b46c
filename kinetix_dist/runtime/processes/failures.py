"""Failures and losses of processes: which process, where, why, what to change, and how long it took to go on.

An error of the work itself (`ProcessFailedError`) would come again, so it ends the run; a process that is gone
(`WorkerLostError`) is started again. A recovery is measured from the loss to the first new result (an update, a batch,
a buffer): starting, loading and compiling are inside.
"""

from __future__ import annotations

import dataclasses
import os
import socket
import time
import traceback
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kinetix_dist.runtime.processes.gpu_memory import Budget, gib
from kinetix_dist.telemetry.names import ROLES

MAX_REASON = 400  # characters: XLA's messages can be pages

# In the text of an error: XLA's pool is full; or memory of the device beyond it, which Warp and CUDA allocate.
POOL_IS_FULL = ("RESOURCE_EXHAUSTED",)
DEVICE_IS_FULL = ("Warp CUDA error 2", "CUDA_ERROR_OUT_OF_MEMORY", "cudaErrorMemoryAllocation")
# Errors of a process whose group lost another one, in a collective or from the coordinator.
GROUP_IS_BROKEN = (
    "heartbeat",
    "Gloo",
    "gloo",
    "NCCL",
    "coordination",
    "DEADLINE_EXCEEDED",
    "UNAVAILABLE",
    "Connection reset",
    "Connection closed",
    "Socket closed",
)
# Error of rank 0 of a group where another program took the coordinator's port after it was found free.
PORT_IS_TAKEN = ("Failed to start RPC server",)

ADVICE = {
    "worker": "lower rollout.num_envs, raise ppo.minibatches, or lower run.curator_memory_gib "
    "(with run.num_curators 0: curriculum.scoring_batch)",
    "learner": "lower rollout.num_envs, raise ppo.minibatches, or raise run.num_learners",
    "rollout": "lower rollout.num_envs or raise run.num_rollout_actors",
    "evaluator": "lower evaluation.attempts, or set evaluation.every, .every_seconds and recording.every to 0",
    "curator": "raise run.curator_memory_gib or lower curriculum.scoring_batch",
}


class WorkerLostError(RuntimeError):
    """A process died or hung: what it held is gone, and it can be started again."""

    def __init__(self, message: str, *, process: str = "", since: float | None = None) -> None:
        """process: which. since: time.monotonic() of the last sign of life, where that is known."""
        super().__init__(message)
        self.process = process
        self.since = since
        self.section = ""  # of the run, in which it was noticed


class RayFailedError(RuntimeError):
    """Ray itself did not start on this machine, or was ended."""


class InputLostError(WorkerLostError):
    """A process that is well was to work with what a lost one did not come to make; `process` is the lost one."""


def silent(process: str, seconds: float) -> WorkerLostError:
    """Loss of a process that has not answered for so long."""
    return WorkerLostError(
        f"{process} has not answered for {seconds:.0f} s", process=process, since=time.monotonic() - seconds
    )


class TooManyLossesError(RuntimeError):
    """More processes were lost within an hour than a run may lose."""


class ProcessFailedError(RuntimeError):
    """A process raised an error in a call."""

    def __init__(self, process: str, reason: str, details: str = "") -> None:
        """`reason`: one line. `details`: the traceback, for a log file."""
        super().__init__(process, reason, details)
        self.process = process
        self.reason = reason
        self.details = details

    def __str__(self) -> str:
        return f"{self.process} {self.reason}"

    @property
    def is_loss_of_group(self) -> bool:
        """Says whether another process of its group is the cause: a collective broke."""
        return any(sign in self.reason for sign in GROUP_IS_BROKEN)

    @property
    def is_taken_port(self) -> bool:
        """Says whether the port of its group's coordinator was taken: with another one it may go well."""
        return any(sign in self.reason for sign in PORT_IS_TAKEN)


def failure_of(process: str, error: Exception, budget: Budget | None) -> ProcessFailedError:
    """The error of a process in one line, with its traceback. `budget`: of GPU memory; None on a CPU."""
    text = " ".join(str(error).split()) or type(error).__name__
    if not isinstance(error, ValueError | OSError):
        text = f"{type(error).__name__}: {text}"
    details = "".join(traceback.format_exception(error))
    if isinstance(error, MemoryError) or any(sign in text for sign in (*POOL_IS_FULL, *DEVICE_IS_FULL)):
        reason = f"ran out of memory {_memory(process, text, budget)} ({_short(text, MAX_REASON // 2)})"
        return ProcessFailedError(process, reason, details)
    return ProcessFailedError(process, f"failed: {_short(text, MAX_REASON)}", details)


def _memory(process: str, text: str, budget: Budget | None) -> str:
    host, advice = socket.gethostname(), ADVICE[process.split()[0]]
    if budget is None:
        return f"on {host}; {advice}"
    where = f"on GPU {os.environ.get('CUDA_VISIBLE_DEVICES', '0')} of {host}, {budget.gpu.name}"
    amount = f"its budget is {gib(budget.total_bytes)}, {gib(budget.pool_bytes)} of it XLA's pool"
    if any(sign in text for sign in DEVICE_IS_FULL):
        return (
            f"{where}, beyond XLA's pool: {amount}, and what is left was not enough or is taken by another program; "
            f"set run.gpu_memory_gib below the {gib(budget.gpu.total_bytes)} there are"
        )
    return f"{where}: {amount}, which is full; {advice}"


def _short(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[:length]} ..."


HOUR_S = 3600.0
MAX_LOG_BYTES = 65536  # of the end of a log that is stored


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loss:
    """One process that was lost."""

    process: str  # "worker 1"
    role: str
    section: str
    update: int  # updates done then
    since: float  # time.monotonic()


class Losses:
    """Losses of one run."""

    def __init__(
        self,
        *,
        limit: int = 0,
        on_event: Callable[..., None] = lambda kind, **details: None,
        on_note: Callable[[str], None] = lambda message: None,
        on_log: Callable[[str, str], Path | None] = lambda name, text: None,
    ) -> None:
        """limit: of losses within an hour. on_log(name, text): stores the last output of a process; returns where."""
        self._limit = limit
        self._on_log = on_log
        self._logs: dict[str, Path] = {}  # by process: the files of this host that they write their errors to
        self._on_event = on_event
        self._on_note = on_note
        self.update = 0  # done so far
        self.restarts = dict.fromkeys(ROLES, 0)
        self.recovery_seconds: dict[str, float] = {}  # of the last recovery, by role
        self._times: deque[float] = deque()

    @property
    def num_restarts(self) -> int:
        return sum(self.restarts.values())

    def started(self, process: str, where: dict[str, Any]) -> None:
        """where: what it said of itself (`facts.whereabouts`)."""
        self._logs.pop(process, None)
        if where.get("log") is not None and where["host"] == socket.gethostname():
            self._logs[process] = Path(where["log"])

    def lost(self, error: WorkerLostError) -> Loss:
        """Tells of a loss and counts it. Raises TooManyLossesError where that was one too many within an hour."""
        now = time.monotonic()
        role = error.process.split()[0] if error.process else ""
        role = role if role in ROLES else "worker"  # no process is named: it is the group then
        since = error.since if error.since is not None else now
        loss = Loss(process=error.process, role=role, section=error.section, update=self.update, since=since)
        self._times.append(now)
        while self._times[0] < now - HOUR_S:
            self._times.popleft()
        count = len(self._times)
        details = {"process": loss.process, "role": role, "section": loss.section, "update": loss.update}
        stored = self._store_logs(loss)
        log = {"log": str(stored)} if stored is not None else {}
        self._on_event("process_lost", **details, error=str(error), restart=count, **log)
        where = f" (section {loss.section!r})" if loss.section else ""
        where += f"; what it wrote last is in {stored}" if stored is not None else ""
        if count > self._limit:
            raise TooManyLossesError(
                f"{error}{where}; that is loss {count} within an hour, and run.max_restarts is {self._limit}"
            ) from error
        self.restarts[role] += 1
        self._on_note(f"{error}{where}; restart {count} of {self._limit} within an hour")
        return loss

    def _store_logs(self, loss: Loss) -> Path | None:
        """Stores the ends of the logs of the lost process and the others of its role: one that dies takes its group
        along.

        Returns where that of the lost one is, if it wrote anything.
        """
        found = None
        for process, log in self._logs.items():
            if process.split()[0] == loss.role and (text := _end_of(log)):
                stored = self._on_log(process.replace(" ", "_"), text)
                found = stored if process == loss.process else found
        return found

    def recovered(self, loss: Loss, *, update: int) -> None:
        """The first new result after a loss is there: after each loss, where there were several. update: at which."""
        seconds = time.monotonic() - loss.since
        self.recovery_seconds[loss.role] = seconds
        details = {"process": loss.process, "role": loss.role, "section": loss.section}
        self._on_event("recovered", **details, from_update=loss.update, to_update=update, seconds=round(seconds, 3))

    def metrics(self) -> dict[str, float]:
        """`runtime/restarts` and `runtime/recovery_seconds`, in all and by role where there were any."""
        found: dict[str, float] = {"runtime/restarts": float(self.num_restarts)}
        found |= {f"runtime/restarts_{role}": float(count) for role, count in self.restarts.items() if count}
        if self.recovery_seconds:
            found["runtime/recovery_seconds"] = max(self.recovery_seconds.values())
        return found | {f"runtime/recovery_seconds_{role}": value for role, value in self.recovery_seconds.items()}


def _end_of(log: Path) -> str:
    """The last lines of a file; empty where it cannot be read."""
    try:
        with log.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - MAX_LOG_BYTES))
            return file.read().decode(errors="replace").strip()
    except OSError:
        return ""
