"""Client of the fork server, which Ray runs to set up a process of a run (`fork_server.py`).

    python fork_client.py /.../default_worker.py ARGUMENTS...        stdin, stdout and stderr are handed over

It stands in for Ray's own setup_worker.py, and runs that where no server is to be used, or the server cannot give a
process. It imports nothing of the project, nor Ray: it has to be short.
"""

from __future__ import annotations

import array
import json
import os
import socket
import struct
import sys
from pathlib import Path

SERVER = "KINETIX_DIST_FORK_SERVER"  # environment variable: the name of the server
CAN_FORK, FORK, FORKED = b"1", b"2", b"3"  # of the server, of the client, of the server
ANSWER_LIMIT_S = 20.0  # it may still be importing; after run.heartbeat_seconds the process would count as lost
_CONTEXT, _LANGUAGE = "--serialized-runtime-env-context=", "--language="


def main(arguments: list[str]) -> None:
    """Ends with exit status 0 where the server has forked a process."""
    context = next((one.removeprefix(_CONTEXT) for one in arguments if one.startswith(_CONTEXT)), "{}")
    environment = {**os.environ, **json.loads(context).get("env_vars", {})}
    command = [one for one in arguments if not one.startswith((_CONTEXT, _LANGUAGE))]
    if SERVER not in environment or not _is_forked(environment, command):
        of_ray = str(Path(command[0]).with_name("setup_worker.py"))
        os.execv(sys.executable, [sys.executable, of_ray, *arguments])


def _is_forked(environment: dict[str, str], command: list[str]) -> bool:
    request = {"command": command, "environment": environment, "directory": str(Path.cwd())}
    content = json.dumps(request, allow_nan=False).encode()
    streams = array.array("i", [0, 1, 2])
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
            server.settimeout(ANSWER_LIMIT_S)
            server.connect("\0" + environment[SERVER])
            check_user(server)
            server.sendmsg([len(content).to_bytes(8, "big")], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
            server.sendall(content)
            if server.recv(1) != CAN_FORK:
                return False
            server.sendall(FORK)  # who has gone on without the server never says this, and gets no second process
            return server.recv(1) == FORKED
    except OSError as error:
        sys.stderr.write(f"no fork server ({error}): starts Python\n")  # into the log of Ray's node
        return False


def check_user(peer: socket.socket) -> None:
    """Raises OSError where another user is at the other end: the name of a server that ended is free, and a request is
    secret."""
    _, user, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    if user != os.getuid():
        raise PermissionError(f"user {user} is at the other end")


if __name__ == "__main__":
    main(sys.argv[1:])
