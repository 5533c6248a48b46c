"""The commands `kinetix-dist dashboard`, `edit` and `levels play` as processes, and requests to them."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.helpers import PATIENCE_S, ended_after, python_path

START_SECONDS = 60.0


class Server:
    """A server that runs. `cookie` is what a browser has after it opened the printed address."""

    def __init__(self, process: subprocess.Popen[str], lines: list[str]) -> None:
        self.process = process
        self.lines = lines
        match = re.search(r"http://127\.0\.0\.1:(\d+)/\?token=(\S+)", "\n".join(lines))
        assert match, lines
        self.port, self.token, self.address = int(match[1]), match[2], match[0]
        self.cookie = ""
        status, headers, _ = self.request(f"/?token={self.token}")
        assert status == 200
        self.cookie = headers["Set-Cookie"].split(";")[0]

    def request(
        self, path: str, *, method: str = "GET", headers: dict[str, str] | None = None, body: bytes | None = None
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers, content. The path goes out as it is, with its dots."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            own = {"Cookie": self.cookie} if self.cookie else {}
            connection.request(method, path, body=body, headers=own | (headers or {}))
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def json(self, path: str) -> Any:
        status, _, content = self.request(path)
        found = json.loads(content)
        assert status == 200, found
        return found

    def error(self, path: str) -> tuple[int, str]:
        status, _, content = self.request(path)
        assert status >= 400
        return status, json.loads(content)["error"]


def command(*arguments: str, name: str = "dashboard") -> list[str]:
    return [sys.executable, "-m", "kinetix_dist.cli.main", *name.split(), *arguments]


def environment(**more: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": python_path(), "PYTHONUNBUFFERED": "1"} | more


@contextmanager
def serving(*arguments: str | Path, name: str = "dashboard", **more: str) -> Iterator[Server]:
    """The server over paths and options, at a free port. `name`: of the command; `more`: environment."""
    process = subprocess.Popen(
        command("--port", "0", *map(str, arguments), name=name),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment(**more),
    )
    assert process.stdout is not None
    lines: list[str] = []
    try:
        with ended_after(process):
            while not any("Ctrl-C" in line for line in lines):
                line = process.stdout.readline()
                assert line, f"the server ended, or did not begin in {PATIENCE_S:g} s: {lines}"
                lines.append(line)
        yield Server(process, lines)
    finally:
        end(process)


def end(process: subprocess.Popen[str]) -> str:
    """Ends it in order; what it printed since."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    try:
        output, _ = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return output


def wait_for(condition: Any, seconds: float = PATIENCE_S) -> Any:
    """The first true value of `condition()`."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError(f"not within {seconds} s")
