"""Processes of a run that start with nearly everything imported: forks of one process that has done so.

    driver --starts--> fork server (imports JAX, Warp, this project and what Ray needs)
    raylet --starts--> fork_client.py --command, environment, streams--> fork server
                                      <--it can; then do; it is done-->  fork server --fork--> the process

Otherwise every process imports for 5 s of a core, at the start and in every recovery. Memory of what is imported is
shared until it is written to.

    kinetix_dist.runtime.processes.fork_server DESCRIPTOR MODULE...        stdin is a pipe from the driver

consumes      requests, at a socket of the abstract namespace: of this user alone, and without a file to leave behind
produces      processes, its own children, so that a search for the processes of a driver finds them
waits for     requests; the end of the pipe
unblocked by  the end of the driver, or `ForkServer.stop`

JAX must not have computed anything in a process that forks, and CUDA must not have started: threads and driver are not
there in the copy. Importing does neither (a test looks). Processes on machines of a cluster that others started are not
forked.
"""

from __future__ import annotations

import array
import contextlib
import dataclasses
import gc
import importlib
import json
import os
import runpy
import secrets
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import psutil

from kinetix_dist.child_python import command_of
from kinetix_dist.runtime.processes.fork_client import CAN_FORK, FORK, FORKED, SERVER, check_user
from kinetix_dist.runtime.processes.ray_setup import processes_set_up_by

CLIENT = Path(__file__).with_name("fork_client.py")
BACKLOG = 256  # requests that wait while it imports
# Read when JAX is imported: a process has to have those of the server. JAX_PLATFORMS is set again in the process.
READ_AT_IMPORT = ("JAX_", "PYTHON")
PLATFORMS = "JAX_PLATFORMS"
NUM_STREAMS = 3
CLIENT_LIMIT_S = 5.0  # of a client that is there and says nothing


class ForkServer:
    """The driver's side: starts the server and keeps the pipe open."""

    def __init__(self, modules: Sequence[str] = ()) -> None:
        """modules: that its processes import, by name."""
        self.modules = tuple(modules)
        self._name = f"kinetix-fork-{secrets.token_hex(16)}"
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            listener.bind("\0" + self._name)
            listener.listen(BACKLOG)
            self._process = subprocess.Popen(
                command_of("kinetix_dist.runtime.processes.fork_server", listener.fileno(), *modules),
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[listener.fileno()],
                start_new_session=True,  # a Ctrl-C at the terminal is for the driver
            )

    @staticmethod
    def can_run() -> bool:
        """Says whether this system has abstract sockets."""
        return sys.platform == "linux"

    @property
    def environment(self) -> dict[str, str]:
        """Variables of a process that is to be forked."""
        return {SERVER: self._name}

    @staticmethod
    def used_by_ray() -> contextlib.AbstractContextManager[None]:
        """Lets a Ray that is started inside set up its processes by `fork_client.py`."""
        return processes_set_up_by(CLIENT)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def why_no_answer(self) -> str:
        """Reason why it does not answer, as far as can be seen; empty: none."""
        try:
            if psutil.Process(self.pid).status() == psutil.STATUS_STOPPED:
                return "is stopped"
        except psutil.NoSuchProcess:
            self._process.wait()
        return "" if (status := self._process.poll()) is None else f"ended with status {status}"

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a process."""

    command: list[str]  # a script and its arguments
    environment: dict[str, str]
    directory: str
    streams: tuple[int, ...]  # descriptors of stdin, stdout and stderr


def serve(listener_number: int, modules: Sequence[str]) -> Request | None:
    """Returns None when stdin has ended; and in each process that was forked, its request.

    listener_number: descriptor of a socket that listens. modules: to import first.
    """
    with socket.socket(fileno=listener_number) as listener:
        _import_all(modules)
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel collects children
        while True:
            ready, _, _ = select.select([sys.stdin, listener], [], [])
            if sys.stdin in ready:
                return None
            with listener.accept()[0] as client, contextlib.suppress(OSError, ValueError):
                if (request := _forked(client)) is not None:
                    return request


def _import_all(modules: Sequence[str]) -> None:
    """Imports the modules of every process of a run: not Ray itself, whose random numbers would be the same in all
    forks."""
    gc.disable()  # all that is imported stays: looking for garbage in it takes a seventh of the time
    import google.protobuf.json_format  # noqa: F401
    import jax  # noqa: F401
    import jsonschema  # noqa: F401
    import requests  # noqa: F401

    for module in modules:
        importlib.import_module(module)
    gc.enable()
    gc.collect()
    gc.freeze()  # else a first collection in each process would write to all that is shared


def _forked(client: socket.socket) -> Request | None:
    """Forks where the request can be granted; the request in the new process, None in this one."""
    check_user(client)
    client.settimeout(CLIENT_LIMIT_S)
    request = _received(client)
    try:
        if not _is_like_here(request.environment):
            return None
        client.sendall(CAN_FORK)
        if client.recv(1) != FORK:  # it has gone on without this server
            return None
        if os.fork() == 0:
            return dataclasses.replace(request, streams=tuple(map(os.dup, request.streams)))
        client.sendall(FORKED)
        return None
    finally:
        for stream in request.streams:
            os.close(stream)


def _received(client: socket.socket) -> Request:
    """Raises ValueError where that is none."""
    size = array.array("i").itemsize * NUM_STREAMS
    head, rights, _, _ = client.recvmsg(8, socket.CMSG_SPACE(size))
    streams = array.array("i")
    for level, kind, content in rights:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            streams.frombytes(content[:size])
    if len(head) < 8 or len(streams) < NUM_STREAMS:
        raise ValueError("not a request")
    content, length = b"", int.from_bytes(head, "big")
    while len(content) < length:
        if not (more := client.recv(length - len(content))):
            raise ValueError("an unfinished request")
        content += more
    return Request(**json.loads(content), streams=tuple(streams))


def _is_like_here(environment: Mapping[str, str]) -> bool:
    def read_at_import(variables: Mapping[str, str]) -> dict[str, str]:
        return {
            name: value
            for name, value in variables.items()
            if name.startswith(READ_AT_IMPORT) and name != PLATFORMS and value
        }

    return read_at_import(environment) == read_at_import(os.environ)


def become(request: Request) -> None:
    """Runs the script of a request as Python would."""
    os.setpgid(0, 0)  # Ray ends processes by their group
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for number, stream in enumerate(request.streams):
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(request.directory)
    os.environ.clear()
    os.environ.update(request.environment)
    import jax

    jax.config.update("jax_platforms", os.environ.get(PLATFORMS) or None)
    sys.argv = request.command
    sys.path.insert(0, str(Path(sys.argv[0]).parent))
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    if (request := serve(int(sys.argv[1]), sys.argv[2:])) is not None:
        become(request)
