"""What is done otherwise than Ray does it, and has no public way (ray 2.60)."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

from kinetix_dist.child_python import directories_outside_python
from kinetix_dist.errors import one_line
from kinetix_dist.runtime.processes.failures import RayFailedError

if TYPE_CHECKING:
    from ray.job_config import JobConfig

# Methods of Ray's node that start processes which nothing here asks: the autoscaler's monitor, what passes logs of
# actors on to the driver (`log_to_driver` is off), and the server of the dashboard and of `ray job`.
SERVICES = ("start_monitor", "start_log_monitor", "start_api_server")

SERVERS = ("gcs_server", "raylet")


def print_nothing() -> None:
    """Ray prints on stdout, with pages of advice, what its nodes say of lost processes: `Losses` says it in a line."""
    from ray._private import worker

    worker.print_to_stdstream = lambda data, ignore_prefix: None


def job_of_this_import_path() -> JobConfig:
    """For `ray.init`: processes import what this one does. Ray would put the current directory of the driver first,
    where another checkout or a jax.py may lie. Python's own directories, and those of its installed packages, are left
    to the Python of each node, which may lie elsewhere."""
    from ray.job_config import JobConfig

    class _Job(JobConfig):
        def _serialize(self) -> str:
            # Ray has added its directories by now. A process inserts one after the other: the last comes first.
            self._py_driver_sys_path = directories_outside_python()[::-1]
            return super()._serialize()

    return _Job()


@contextlib.contextmanager
def own_signals() -> Generator[None]:
    """Around `ray.init`, which would take SIGTERM for itself and end with a status of its own."""
    from ray._private import utils

    with _replaced(utils, "set_sigterm_handler", lambda handler: None):
        yield


@contextlib.contextmanager
def servers_in_their_own_groups() -> Generator[None]:
    """Around a `ray.init` that starts Ray: a signal to the process group of the driver, as timeout(1) sends it, is not
    for Ray's servers, which would end themselves while the run finishes its update and saves."""
    from ray._private import services

    with _replaced(services, "ConsolePopen", functools.partial(services.ConsolePopen, process_group=0)):
        yield


@contextlib.contextmanager
def without_services() -> Generator[None]:
    """Around a `ray.init` that starts Ray: without SERVICES, which take half of the CPU seconds of such a start.

    Raises RayFailedError where it does not: Ray gives its node 30 s, whatever else the machine does.
    """
    from ray._private.node import Node

    with contextlib.ExitStack() as replacements:
        for method in SERVICES:
            replacements.enter_context(_replaced(Node, method, lambda node, **options: None))
        try:
            yield
        except Exception as error:  # a plain one where it took too long
            load = os.getloadavg()[0] / (os.cpu_count() or 1)
            raise RayFailedError(
                f"Ray did not start on this machine, where {load:.1f} programs want each core ({one_line(error)}); its "
                "logs are in /tmp/ray/session_latest/logs; train without it: --run.placement local"
            ) from error


def own_servers() -> dict[str, psutil.Process]:
    """By name: processes that a Ray which this process started cannot be without."""
    return {child.name(): child for child in psutil.Process().children() if child.name() in SERVERS}


@contextlib.contextmanager
def processes_set_up_by(script: Path) -> Generator[None]:
    """A Ray that is started inside runs `script` instead of its own setup_worker.py."""
    from ray._private import ray_constants

    # Ray joins it to a directory: an absolute path stays what it is.
    with _replaced(ray_constants, "SETUP_WORKER_FILENAME", str(script)):
        yield


@contextlib.contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Generator[None]:
    of_ray = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, of_ray)
