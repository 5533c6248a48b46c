"""What went wrong in a process, in one line: which process, where, why and what to change.

An error of the work itself (`ProcessFailedError`) would come again, so it ends the run; a process that is gone
(`WorkerLostError`) is started again.
"""

from __future__ import annotations

import os
import socket
import time
import traceback

from kinetix_dist.runtime.processes.gpu_memory import Budget, gib

MAX_REASON = 400  # characters: XLA's messages can be pages

# In the text of an error: XLA's pool is full; or memory of the device beyond it, which Warp and CUDA ask for.
POOL_IS_FULL = ("RESOURCE_EXHAUSTED",)
DEVICE_IS_FULL = ("Warp CUDA error 2", "CUDA_ERROR_OUT_OF_MEMORY", "cudaErrorMemoryAllocation")
# What a process hears whose group lost another one, in a collective or from the coordinator.
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
# What rank 0 of a group hears where another program took the coordinator's port after it was found free.
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
    """Of a process that has not answered for so long."""
    return WorkerLostError(
        f"{process} has not answered for {seconds:.0f} s", process=process, since=time.monotonic() - seconds
    )


class TooManyLossesError(RuntimeError):
    """More processes were lost within an hour than a run may lose."""


class ProcessFailedError(RuntimeError):
    """A process raised an error at what it was asked to do."""

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
        """Whether another process of its group is the cause: a collective broke."""
        return any(sign in self.reason for sign in GROUP_IS_BROKEN)

    @property
    def is_taken_port(self) -> bool:
        """Whether the port of its group's coordinator was taken: with another one it may go well."""
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
