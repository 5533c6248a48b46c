"""A real Ray cluster on this machine, by the commands of cluster/README.md: `ray start` for a head and for nodes."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import psutil

from tests.helpers import python_path

START_LIMIT_S = 120.0  # a machine that is busy with other tests is slow
RAY = str(Path(sys.executable).with_name("ray"))


class Raylets:
    """`ray start --block` processes. All are ended by `stop`, whatever they started with them."""

    def __init__(self, log: Path, environment: Mapping[str, str] | None = None) -> None:
        self._log = log
        self._processes: list[subprocess.Popen[bytes]] = []
        self._environment = {**os.environ, "PYTHONPATH": python_path(), "RAY_USAGE_STATS_ENABLED": "0"}
        self._environment |= environment or {}
        for name in ("RAY_ADDRESS", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"):
            self._environment.pop(name, None)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.address = f"{_own_address()}:{port}"
        self._port = port

    def start_head(self, *options: str) -> None:
        command = [RAY, "start", "--head", f"--port={self._port}", "--include-dashboard=false", "--block", *options]
        self._start(command, {}, [])

    def start_node(
        self, *options: str, environment: Mapping[str, str] | None = None, within: Sequence[str] = ()
    ) -> None:
        """within: a command that runs what follows it, in a namespace say."""
        command = [RAY, "start", f"--address={self.address}", "--block", *options]
        self._start(command, environment or {}, within)

    def _start(self, command: list[str], environment: Mapping[str, str], within: Sequence[str]) -> None:
        log = self._log.with_suffix(f".{len(self._processes)}")
        with log.open("wb") as file:
            process = subprocess.Popen(
                [*within, *command],
                env={**self._environment, **environment},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._processes.append(process)
        deadline = time.monotonic() + START_LIMIT_S
        while "Ray runtime started" not in log.read_text(errors="replace"):
            assert process.poll() is None, log.read_text(errors="replace")[-2000:]
            assert time.monotonic() < deadline, log.read_text(errors="replace")[-2000:]
            time.sleep(0.1)

    @property
    def pids(self) -> list[int]:
        """Process ids of the commands; the processes that they started are their children."""
        return [process.pid for process in self._processes]

    def stop_last(self) -> None:
        """SIGKILL for a node and all that it started: as if its machine were gone."""
        process = self._processes.pop()
        if process.poll() is not None:  # a node that could not start: nothing to kill, and the others still are
            return
        family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        for member in family:
            if member.is_running():
                member.send_signal(signal.SIGKILL)
        process.wait()
        psutil.wait_procs(family, timeout=10)

    def stop(self) -> None:
        while self._processes:
            self.stop_last()


def _own_address() -> str:
    """Address of the interface that leads out of this host, as Ray finds it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return probe.getsockname()[0]
        except OSError:
            return "127.0.0.1"
