"""Processes that are forked with everything imported: like any other, and only where it makes no difference."""

import array
import json
import os
import signal
import socket
import subprocess
import sys
import time

import psutil
import pytest

from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.cores.build import MODULES
from kinetix_dist.runtime.processes.fork_client import ANSWER_LIMIT_S, CAN_FORK, FORK, FORKED, SERVER
from kinetix_dist.runtime.processes.fork_server import CLIENT, ForkServer

LIMIT_S = 120.0  # importing, on a machine that is busy with other tests
SCRIPT = """
import os, random, sys
print(os.getppid(), os.getcwd(), sys.argv[1:], os.environ["GIVEN"], "jax" in sys.modules, "ray" in sys.modules,
      random.random(), sep="|", flush=True)
import jax
print(jax.devices()[0].platform, file=sys.stderr, flush=True)
"""
# Of Ray, in whose place the client runs: it says that it ran.
OF_RAY = 'import sys; print("set up by Ray", sys.argv[1:])'

pytestmark = pytest.mark.skipif(not ForkServer.can_run(), reason="no abstract sockets here")


@pytest.fixture(scope="module")
def server():
    server = ForkServer()
    yield server
    server.stop()


@pytest.fixture
def launch(tmp_path):
    """The file with what a process wrote, whose client requests tmp_path/default_worker.py."""
    (tmp_path / "default_worker.py").write_text(SCRIPT)
    (tmp_path / "setup_worker.py").write_text(OF_RAY)

    def launched(variables):
        out = tmp_path / "out"
        with out.open("wb") as file:
            subprocess.run(
                [sys.executable, CLIENT, tmp_path / "default_worker.py", "--one=a b", "--language=PYTHON"],
                env={**os.environ, "JAX_PLATFORMS": "cpu", "GIVEN": "7", **variables},
                cwd=tmp_path,
                stdout=file,
                stderr=file,
                timeout=LIMIT_S,
                check=True,
            )
        return out

    return launched


def _lines(path, number):
    deadline = time.monotonic() + LIMIT_S
    while len(lines := path.read_text().splitlines()) < number:
        assert time.monotonic() < deadline, lines
        time.sleep(0.05)
    return lines


def test_a_forked_process_has_what_it_was_given_and_everything_imported(server, launch, tmp_path):
    found = set()
    for _ in range(2):
        said, platform = _lines(launch(server.environment), 2)
        parent, directory, arguments, given, has_jax, has_ray, at_random = said.split("|")
        assert (int(parent), directory, given) == (server.pid, str(tmp_path), "7")
        assert (arguments, has_jax, has_ray, platform) == ("['--one=a b']", "True", "False", "cpu")
        found.add(at_random)
    assert len(found) == 2


@pytest.mark.parametrize("case", ["none is named", "it is gone", "it has other settings of JAX"])
def test_where_nothing_can_be_forked_ray_sets_the_process_up(server, launch, case, tmp_path):
    variables = {
        "none is named": {},
        "it is gone": {SERVER: "missing"},
        "it has other settings of JAX": {**server.environment, "JAX_ENABLE_X64": "1"},
    }
    *rest, last = _lines(launch(variables[case]), 2 if case == "it is gone" else 1)
    assert last == "set up by Ray ['" + str(tmp_path / "default_worker.py") + "', '--one=a b', '--language=PYTHON']"
    assert not rest or "no fork server" in rest[0]


def test_who_has_gone_on_without_the_server_gets_no_second_process(server, tmp_path):
    """Ray would have two processes for one, and lose both."""
    written = tmp_path / "written"
    script = tmp_path / "script.py"
    script.write_text(f"open({str(written)!r}, 'w').write('here')")
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    request = json.dumps({"command": [str(script)], "environment": environment, "directory": str(tmp_path)}).encode()
    for is_confirmed in (False, True):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(LIMIT_S)
            client.connect("\0" + server.environment[SERVER])
            streams = array.array("i", [0, 1, 2])
            client.sendmsg([len(request).to_bytes(8, "big")], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
            client.sendall(request)
            if is_confirmed:
                assert client.recv(1) == CAN_FORK
                assert not written.exists()  # of the one before
                client.sendall(FORK)
                assert client.recv(1) == FORKED
    deadline = time.monotonic() + LIMIT_S
    while not written.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_one_that_cannot_answer_is_known():
    one = ForkServer()
    assert one.why_no_answer == ""
    for number_of_signal, why in ((signal.SIGSTOP, "is stopped"), (signal.SIGKILL, "ended with status -9")):
        os.kill(one.pid, number_of_signal)
        deadline = time.monotonic() + LIMIT_S
        while one.why_no_answer != why:
            assert time.monotonic() < deadline, one.why_no_answer
            time.sleep(0.01)
    one.stop()


def test_the_client_gives_up_before_its_process_counts_as_lost():
    assert recipe("tiny").run.heartbeat_seconds / 2 >= ANSWER_LIMIT_S


def test_importing_starts_neither_a_device_nor_a_thread():
    """Else a forked process could not use a GPU, or wait for ever."""
    look = (
        "import importlib, sys, threading\n"
        "for module in sys.argv[1:]: importlib.import_module(module)\n"
        "from jax._src import xla_bridge\n"
        "from warp._src import context\n"
        "print(xla_bridge._backends, context.runtime, threading.active_count())"
    )
    done = subprocess.run(
        [sys.executable, "-c", look, *MODULES], capture_output=True, text=True, check=True, timeout=LIMIT_S
    )
    assert done.stdout.strip() == "{} None 1"


def test_it_ends_with_its_driver():
    """However that ends: the pipe closes."""
    script = (
        "import os, signal; from kinetix_dist.runtime.processes.fork_server import ForkServer\n"
        "print(ForkServer().pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, check=False, timeout=LIMIT_S
    )
    pid, deadline = int(done.stdout), time.monotonic() + LIMIT_S
    while psutil.pid_exists(pid):
        assert time.monotonic() < deadline
        time.sleep(0.1)
