"""Who may talk to Ray: its token, and joining a cluster that asks for one.

Whoever can connect to Ray and knows its token runs code as its user. Ray reads the token from `RAY_AUTH_TOKEN`, from
the file that `RAY_AUTH_TOKEN_PATH` names, or from ~/.ray/auth_token, which it writes readable by everybody.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

from kinetix_dist.runtime.processes.placement import PlacementError

_ONLY_OURS = 0o600
_CONNECT_TIMEOUT_S = 5.0


def token_file() -> Path | None:
    """Where Ray will read its token; None where it is in the environment, or none is asked for."""
    if os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_MODE", "").lower() == "disabled":
        return None
    if path := os.environ.get("RAY_AUTH_TOKEN_PATH"):
        return Path(path)
    return Path.home() / ".ray" / "auth_token"


def use_token() -> None:
    """Before Ray is imported to join a cluster: Ray takes a token along only where this is set, though `ray start
    --head` asks for one wherever it finds one. A cluster that asks for none ignores it."""
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
            f"Ray's token file {path} cannot be kept from others ({error.strerror}); make it yours with mode 600, or "
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

    try:
        with _console_held_back() as held:
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
def _console_held_back() -> Generator[bytearray]:
    """What is written to stderr inside, by C++ too, is in the bytearray afterwards."""
    held = bytearray()
    sys.stderr.flush()
    console = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield held
        finally:
            sys.stderr.flush()
            os.dup2(console, 2)
            os.close(console)
            file.seek(0)
            held += file.read()


def _is_there(address: str) -> bool:
    """Whether somebody listens at "host:port"; True for addresses of other forms ("auto"), which Ray looks up."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        return True
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_TIMEOUT_S):
            return True
    except OSError:
        return False
