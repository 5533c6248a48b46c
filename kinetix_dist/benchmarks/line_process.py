"""A process that is asked by JSON lines: an engine that needs an environment, a revision or a device of its own."""

from __future__ import annotations

import json
import subprocess
import tempfile
from typing import Any, Self


class ProcessError(Exception):
    """A process could not do what it was asked to, in its own words."""


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

    def ask(self, request: str, **arguments: Any) -> dict[str, Any]:
        """Sends a request and waits for its answer; raises `ProcessError` when it failed or the process ended."""
        self.send(request, **arguments)
        return self.receive()

    def send(self, request: str, **arguments: Any) -> None:
        """Without waiting; `receive` takes the answer."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": request} | arguments) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return  # it ended: `receive` says so, with its last words

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
