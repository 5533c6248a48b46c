"""Setup of Ray: its token, joining a cluster that requires one, and six changes of Ray that have no public way.

Any program that can connect to Ray and knows its token runs code as its user. Ray reads the token from
`RAY_AUTH_TOKEN`, from the file that `RAY_AUTH_TOKEN_PATH` names, or from ~/.ray/auth_token, which it writes readable by
all users.
"""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
import socket
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

from kinetix_dist.child_python import directories_outside_python
from kinetix_dist.errors import one_line
from kinetix_dist.runtime.processes.failures import RayFailedError
from kinetix_dist.runtime.processes.placement import PlacementError

if TYPE_CHECKING:
    from ray.job_config import JobConfig


_ONLY_OURS = 0o600
_CONNECT_TIMEOUT_S = 5.0


def token_file() -> Path | None:
    """File that Ray will read its token from; None where it is in the environment, or none is required."""
    if os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_MODE", "").lower() == "disabled":
        return None
    if path := os.environ.get("RAY_AUTH_TOKEN_PATH"):
        return Path(path)
    return Path.home() / ".ray" / "auth_token"


def use_token() -> None:
    """Before Ray is imported to join a cluster: Ray takes a token along only where this is set, though `ray start
    --head` requires one wherever it finds one. A cluster that requires none ignores it."""
    path = token_file()
    if os.environ.get("RAY_AUTH_TOKEN") or (path is not None and path.exists()):
        os.environ.setdefault("RAY_AUTH_MODE", "token")


def secure_token() -> Path | None:
    """Before Ray is started here: makes the token file where there is none, for its user alone from the beginning.

    Returns the file where others could read it until now; they cannot any more. Raises PlacementError where that cannot
    be done.
    """
    path = token_file()
    if path is None:
        return None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _ONLY_OURS)
            with os.fdopen(descriptor, "w") as file:
                file.write(secrets.token_hex(32))
        if path.stat().st_mode & 0o077:
            path.chmod(_ONLY_OURS)
            return path
    except OSError as error:
        raise PlacementError(
            f"Ray's token file {path} cannot be hidden from others ({error.strerror}); make it yours with mode 600, or "
            "name another with RAY_AUTH_TOKEN_PATH"
        ) from error
    return None


@contextlib.contextmanager
def joining(address: str) -> Generator[None]:
    """Around `ray.init` for the cluster of `RAY_ADDRESS`: PlacementError where it is not there or refuses our token."""
    if not _is_there(address):
        raise PlacementError(
            f"no Ray cluster answers at {address}, which RAY_ADDRESS names; start it, or unset RAY_ADDRESS to train on "
            "this machine alone"
        )
    import ray.exceptions

    held = bytearray()
    try:
        with _console_held_back(held):
            yield
    except (ConnectionError, ray.exceptions.AuthenticationError) as error:
        held.clear()  # twenty lines from C++ that say the same
        raise PlacementError(
            f"the Ray cluster at {address} refused this process: its token is missing or another; give it that of the "
            "cluster, by RAY_AUTH_TOKEN or by a file of mode 600 that RAY_AUTH_TOKEN_PATH names"
        ) from error
    except ValueError as error:
        raise PlacementError(f"RAY_ADDRESS is {address!r}, no address for Ray ({error}); give HOST:PORT") from error
    except RuntimeError as error:
        if "Version mismatch" not in str(error):
            raise
        held.clear()
        # "The cluster was started with: Ray: A Python: B This process on C was started with: Ray: D Python: E"
        said = " ".join(str(error).split()).removeprefix("Version mismatch: ")
        raise PlacementError(
            f"the Ray cluster at {address} is of other versions: {said}; give all nodes the same Python and "
            "`make install` there (requirements.lock)"
        ) from error
    finally:
        os.write(2, held)


@contextlib.contextmanager
def _console_held_back(held: bytearray) -> Generator[None]:
    """Hold back the console: append text that the block writes to stderr, in C++ too, to `held`."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        console = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            sys.stderr.flush()
            os.dup2(console, 2)
            os.close(console)
            file.seek(0)
            held += file.read()


def _is_there(address: str) -> bool:
    """Says whether a server listens at "host:port"; True for addresses of other forms ("auto"), which Ray looks up."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        return True
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_TIMEOUT_S):
            return True
    except OSError:
        return False


# Methods of Ray's node that start processes which no call here needs: the autoscaler's monitor, what passes logs of
# actors on to the driver (`log_to_driver` is off), and the server of the dashboard and of `ray job`.
SERVICES = ("start_monitor", "start_log_monitor", "start_api_server")

SERVERS = ("gcs_server", "raylet")


# Changes of Ray 2.60. Each names the failure without it; `pyproject.toml` pins 2.60, whose private parts these are.


def print_nothing() -> None:
    """Keeps Ray from printing messages of its nodes about lost processes: `Losses` has one line each.

    Without it stdout gets pages of advice after a kill.
    """
    from ray._private import worker

    worker.print_to_stdstream = lambda data, ignore_prefix: None


def job_of_this_import_path() -> JobConfig:
    """Job config for `ray.init`: processes import what this one does.

    Without it Ray puts the current directory of the driver first, where another checkout or a jax.py may lie. Python's
    own directories, and those of its installed packages, are left to the Python of each node, which may lie elsewhere.
    """
    from ray.job_config import JobConfig

    class _Job(JobConfig):
        def _serialize(self) -> str:
            # Ray has added its directories by now. A process inserts one after the other: the last comes first.
            self._py_driver_sys_path = directories_outside_python()[::-1]
            return super()._serialize()

    return _Job()


@contextlib.contextmanager
def own_signals() -> Generator[None]:
    """Keeps SIGTERM from `ray.init` inside, which would take it.

    Without it a run that is stopped while Ray starts ends with Ray's status, not with 75 and a line.
    """
    from ray._private import utils

    with _replaced(utils, "set_sigterm_handler", lambda handler: None):
        yield


@contextlib.contextmanager
def servers_in_their_own_groups() -> Generator[None]:
    """Starts the servers of a `ray.init` inside in process groups of their own.

    Without it a signal to the process group of the driver, as timeout(1) sends it, ends Ray's servers, and with them
    the update that the run would finish and save.
    """
    from ray._private import services

    with _replaced(services, "ConsolePopen", functools.partial(services.ConsolePopen, process_group=0)):
        yield


@contextlib.contextmanager
def without_services() -> Generator[None]:
    """Leaves SERVICES out of a `ray.init` inside that starts Ray.

    Without it a start takes 15.0 instead of 9.4 CPU seconds, and on two busy cores 29 instead of 18 s of the 30 s that
    Ray gives its node (2026-11-27). Raises RayFailedError where Ray does not start in that time.
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
    """Processes, by name, that a Ray which this process started cannot be without."""
    return {child.name(): child for child in psutil.Process().children() if child.name() in SERVERS}


@contextlib.contextmanager
def processes_set_up_by(script: Path) -> Generator[None]:
    """Has a Ray that is started inside run `script` instead of its own setup_worker.py: for the fork server.

    Without it four processes start in 77 instead of 28 s, and a lost one in 14 instead of 2.6 (docs/operating.md).
    """
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
