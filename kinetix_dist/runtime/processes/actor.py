"""The one Ray actor: a process of a run that joins a group, builds its core, answers calls and pings.

The work itself is a core that knows nothing of processes and is called the same way in local mode. Whatever it raises
leaves as a `ProcessFailedError`: one line and a traceback.
"""

from __future__ import annotations

import dataclasses
import os
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray

from kinetix_dist.child_python import imported_from
from kinetix_dist.models.kernels.support import KernelError
from kinetix_dist.runtime.processes.calls import Call
from kinetix_dist.runtime.processes.failures import failure_of
from kinetix_dist.runtime.processes.gpu_memory import Budget, budget_of, this_gpu
from kinetix_dist.runtime.processes.measures import Meter, Reading, facts_of, whereabouts
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.telemetry.sizes import bytes_of

# Package and file of the Python frames that trace, lower or compile programs.
COMPILING = (
    ("jax", "partial_eval.py"),
    ("jax", "mlir.py"),
    ("jax", "compiler.py"),
    ("warp", "build.py"),
    ("cores", "programs.py"),  # waits for threads that do
)


@dataclasses.dataclass(frozen=True)
class Doing:
    """Activity of a process."""

    what: str
    is_waiting: bool  # for work, a device or its group: another process may be the cause
    is_compiling: bool = False


class InStore:
    """A value in the object store, as an argument of a call that fetches it itself."""

    def __init__(self, reference: Any) -> None:
        self.reference = reference
        self.on_fetched: Callable[[Any], None] = lambda value: None

    def __reduce__(self) -> tuple[Any, ...]:
        return InStore, (self.reference,)

    def fetch(self) -> Any:
        """Waits for it; from another node it comes over the network."""
        value = ray.get(self.reference)
        self.on_fetched(value)
        return value


@ray.remote(concurrency_groups={"control": 1, "background": 1})
class ProcessActor:
    """Holds one core. Methods are called one at a time, except `ping`, `doing` and `read`, which have a thread, and
    `call_in_background`, which has another."""

    def __init__(self, plan: ProcessPlan, build: Callable[..., Any], *arguments: Any) -> None:
        """`build(*arguments)` makes the core, later: a group has to be joined before JAX computes anything."""
        self._plan = plan
        self._build = build
        self._arguments = arguments
        self._budget: Budget | None = None
        self._core: Any = None
        self._meter = Meter(plan.name, plan.role)
        self._working: dict[int, tuple[str, float]] = {}  # by thread: method, since

    def __repr__(self) -> str:
        return self._plan.name  # what Ray's log files call it

    @ray.method(concurrency_group="control")
    def ping(self) -> int:
        """Return the process id, also while a call runs. An answer shows that the process is not stopped."""
        return os.getpid()

    @ray.method(concurrency_group="control")
    def doing(self) -> Doing:
        """Activity of this process, while a call runs too."""
        found = [_doing(thread, *working) for thread, working in list(self._working.items())]
        return next((one for one in found if not one.is_waiting), found[0]) if found else Doing("idle", True)

    @ray.method(concurrency_group="control")
    def read(self) -> Reading:
        """Measurements of this process by itself, while a call runs too."""
        return self._meter.read(has_device=self._core is not None)

    def prepare(self) -> dict[str, Any]:
        """Set XLA's part of the GPU memory, before JAX starts.

        Returns the host, process id and memory of this process, and the origin of its packages.
        """
        with self._failures("prepare"):
            if self._plan.memory is not None:
                self._budget = budget_of(self._plan.name, self._plan.memory, this_gpu())
                os.environ.pop("XLA_PYTHON_CLIENT_MEM_FRACTION", None)  # older name of the variable below
                os.environ.update(self._budget.environment)
            return {**whereabouts(self._budget), "imports": imported_from()}

    def free_address(self) -> str:
        """host:port that this process could listen on now, for the coordinator of a group."""
        host = "127.0.0.1" if os.environ.get("KINETIX_DIST_LOOPBACK", "1") == "1" else _own_address()
        with socket.socket() as probe:
            probe.bind((host, 0))
            return f"{host}:{probe.getsockname()[1]}"

    def join(self, rank: int, coordinator: str, num_processes: int, heartbeat_timeout_s: int) -> None:
        """Form a JAX world with the other processes of the group. Waits for all of them.

        heartbeat_timeout_s: silence of a process after which JAX ends the other processes of its group.
        """
        import jax

        with self._failures("join"):
            jax.distributed.initialize(
                coordinator,
                num_processes,
                rank,
                coordinator_bind_address=coordinator,  # of rank 0; else it would listen on all interfaces
                cluster_detection_method="deactivate",
                heartbeat_timeout_seconds=heartbeat_timeout_s,
            )

    def build(self) -> None:
        with self._failures("build"):
            self._core = self._build(*self._arguments)

    def call(self, method: str, /, *arguments: Any, **named: Any) -> Any:
        """Call the core. The answer is numpy or plain Python."""
        with self._failures(method), self._meter.calling(method):
            answer = Call(method, arguments, named).on(self._core)
            self._meter.moved(arguments, named, answer)
            return answer

    def call_with_header(self, method: str, /, *arguments: Any, **named: Any) -> Generator[Any]:
        """Call a method that returns (header, content), yield the content, then the header with the cost of storing.

        Ray stores the first value of a generator before it asks for the next.
        """
        with self._failures(method), self._meter.calling(method):
            header, content = Call(method, arguments, named).on(self._core)
            self._meter.moved(arguments, named, content)
            began = time.monotonic()
            yield content
            yield {**header, "put": (bytes_of(content), time.monotonic() - began)}

    @ray.method(concurrency_group="background")
    def call_in_background(self, method: str, /, *arguments: Any, **named: Any) -> Any:
        """Call the core while another call runs. The method fetches its arguments from the object store."""
        for argument in (*arguments, *named.values()):
            if isinstance(argument, InStore):
                argument.on_fetched = self._meter.moved
        with self._failures(method):
            return Call(method, arguments, named).on(self._core)

    def facts(self) -> dict[str, Any]:
        with self._failures("facts"):
            return facts_of(self._plan.name, self._budget)

    @contextmanager
    def _failures(self, method: str) -> Generator[None, None, None]:
        self._working[threading.get_ident()] = (method, time.monotonic())
        try:
            yield
        except (ray.exceptions.RayError, KernelError):  # an input is lost, or the settings are refused: not its failure
            raise
        except Exception as error:
            raise failure_of(self._plan.name, error, self._budget) from None
        finally:
            del self._working[threading.get_ident()]


def _doing(thread: int, method: str, since: float) -> Doing:
    frame = sys._current_frames().get(thread)
    if frame is None:
        return Doing(what=f"in {method}", is_waiting=False)
    files = [Path(called.f_code.co_filename).parts for called, _ in traceback.walk_stack(frame)]
    is_compiling = any(package in file and file[-1] == name for file in files for package, name in COMPILING)
    place = f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
    # While a call waits for a device or for a collective, the innermost Python frame is in JAX.
    is_waiting = "jax" in Path(frame.f_code.co_filename).parts
    place = f"compiling, at {place}" if is_compiling else f"at {place}"
    what = f"in {method} for {time.monotonic() - since:.0f} s, {place}"
    return Doing(what=what, is_waiting=is_waiting, is_compiling=is_compiling)


def _own_address() -> str:
    """The address of the interface that leads out of this host (no packet is sent)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))
        return probe.getsockname()[0]
