"""Engines in processes of their own, called by JSON lines, and the published jax2d as one of them.

An engine may need an environment, a revision or a device of its own. Both engines are packages called jax2d, so the
published one has its own environment; bench/peers/jax2d_published.py is the other end. Its Python is, in this order,
$KINETIX_PEER_PYTHON (with $KINETIX_PEER_PYTHONPATH as its PYTHONPATH: for machines where the packages are only
unpacked), or bench/.peers/jax2d, which bench/peers/setup.sh makes.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from kinetix_dist.benchmarks.engine_worlds import DRAWN
from kinetix_dist.benchmarks.measuring import Record
from kinetix_dist.errors import UserError
from kinetix_dist.json_text import json_text


class ProcessError(Exception):
    """Failure of a request, in the words of the process."""


class LineProcess:
    """A process that answers each JSON line with one. Used as a context, which ends it."""

    def __init__(self, name: str, command: list[str], environment: dict[str, str]) -> None:
        self.name = name
        self._messages = tempfile.TemporaryFile("w+")  # noqa: SIM115  closed by close()
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._messages,
            text=True,
            env=environment,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process; it stops by itself when its input is closed."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._messages.close()

    def call(self, request: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Sends a request and waits for its answer; raises `ProcessError` when it failed or the process ended."""
        self.send(request, arguments)
        return self.receive()

    def send(self, request: str, arguments: Mapping[str, Any] | None = None) -> None:
        """Sends a request without waiting; `receive` takes the answer."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json_text({"do": request, **(arguments or {})}) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return  # it ended: `receive` says so, with its last line

    def receive(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._messages.seek(0)
            said = self._messages.read().strip().splitlines() or ["no message"]
            raise ProcessError(f"{self.name}'s process ended: {said[-1]}")
        answer = json.loads(line)
        if not answer.pop("ok"):
            raise ProcessError(answer["error"])
        return answer


PUBLISHED_PRESET = "paper"  # the one solver it has
PUBLISHED_BACKEND = "xla"


class PublishedProcess(LineProcess):
    """The published engine's process."""

    def __init__(self, checkout: Path) -> None:
        """Starts it; raises UserError where the published engine is not installed."""
        script = checkout / "bench" / "peers" / "jax2d_published.py"
        if not script.is_file():
            raise UserError(f"--peers needs {script}, which is in the repository; run from a checkout")
        python = os.environ.get("KINETIX_PEER_PYTHON") or str(
            checkout / "bench" / ".peers" / "jax2d" / "bin" / "python"
        )
        if not Path(python).is_file():
            raise UserError(f"--peers: {python} does not exist; run `bash bench/peers/setup.sh` first")
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        if path := os.environ.get("KINETIX_PEER_PYTHONPATH"):
            environment["PYTHONPATH"] = path
        # Two processes share the device: neither may take all its memory.
        environment.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        super().__init__("the published engine", [python, str(script)], environment)
        try:
            self.description = self.call("describe")
        except ProcessError as error:
            self.close()
            raise UserError(f"--peers: {error}") from error

    def prepare(self, size: str, files: list[Path], worlds: int, steps: int, seed: int) -> PublishedEngine:
        """Compiles for these worlds and runs once."""
        arguments = {"levels": [str(file) for file in files], "worlds": worlds, "steps": steps, "seed": seed}
        self.call("prepare", arguments)
        record = {
            "engine": "published",
            "backend": PUBLISHED_BACKEND,
            "preset": PUBLISHED_PRESET,
            "size": size,
            "worlds": worlds,
            "order": DRAWN,
            "device": self.description["device"],
        }
        return PublishedEngine(process=self, record=record)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublishedEngine:
    """An `engine_speed.Runner` in the other process."""

    process: PublishedProcess
    record: Record

    def restart(self) -> None:
        self.process.call("restart")

    def run(self) -> float:
        return self.process.call("run")["seconds"]
