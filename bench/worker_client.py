"""A client of the engine worker for measurements and tests: a real process, a real pipe, blocking calls."""

from __future__ import annotations

import itertools
import json
import os
import queue
import struct
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

from kinetix_dist.child_python import command_of
from kinetix_dist.studio.server.worker_client import WORKER
from kinetix_dist.studio.worker.frames import Frame, FrameSizes, decode
from kinetix_dist.studio.worker.wire import NOT_FOUND, Message, RequestError, encode, read

REPOSITORY = Path(__file__).resolve().parent.parent

SECONDS = 120.0  # for an answer, after which a worker is taken for hung


class Client:
    """Client of one worker. `slow`: reads nothing before `read_on()`."""

    def __init__(self, *, log: Path, environment: dict[str, str] | None = None, slow: bool = False) -> None:
        self._log = log.open("wb")
        search_path = os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])])
        self.process = subprocess.Popen(
            command_of(WORKER),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            cwd=REPOSITORY,
            env=os.environ | {"PYTHONPATH": search_path} | (environment or {}),
        )
        self._ids = itertools.count(1)
        self._messages: queue.Queue[Message | None] = queue.Queue()
        self._answers: dict[int, Message] = {}
        self.progress: dict[int, list[dict[str, Any]]] = {}
        self.sessions: set[int] = set()  # that were opened
        self.others: list[Message] = []  # frames, ends of episodes, errors without an id
        self._may_read = threading.Event()
        if not slow:
            self.read_on()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.hello: dict[str, Any] = {}
        if not slow:
            self.greet()

    def greet(self) -> None:
        message = self._messages.get(timeout=SECONDS)
        assert message is not None, f"the worker ended: {Path(self._log.name).read_text()[-2000:]}"
        assert message.content["type"] == "hello"
        self.hello = message.content

    def read_on(self) -> None:
        self._may_read.set()

    def hold(self) -> None:
        """Reads nothing more until `read_on`."""
        self._may_read.clear()

    def _read(self) -> None:
        assert self.process.stdout is not None
        while True:
            self._may_read.wait()
            message = read(self.process.stdout)
            self._messages.put(message)
            if message is None:
                return

    def send(self, kind: str, **fields: Any) -> int:
        """Sends a request; its id."""
        number = next(self._ids)
        self.write(encode(Message({"type": kind, "id": number, **fields})))
        return number

    def send_raw(self, number: int, fields: dict[str, Any]) -> None:
        """Sends a message that may hold what JSON forbids, such as NaN."""
        data = json.dumps({"id": number, **fields}).encode()
        self.write(struct.pack("<II", 4 + len(data), len(data)) + data)

    def write(self, data: bytes) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(data)
        self.process.stdin.flush()

    def send_only(self, kind: str, **fields: Any) -> None:
        """A message without an id."""
        self.write(encode(Message({"type": kind, **fields})))

    def take(self, seconds: float = SECONDS) -> bool:
        """Sorts in the next message. False at the end of the pipe."""
        message = self._messages.get(timeout=seconds)
        if message is None:
            return False
        content = message.content
        if content["type"] == "progress":
            self.progress.setdefault(content["id"], []).append(content)
        elif content["type"] in ("reply", "error") and "id" in content:
            self._answers[content["id"]] = message
        else:
            self.others.append(message)
        return True

    def wait(self, number: int, seconds: float = SECONDS) -> Message:
        """The reply to a request; raises its RequestError."""
        end = time.monotonic() + seconds
        while number not in self._answers:
            assert self.take(end - time.monotonic()), f"the worker ended: {Path(self._log.name).read_text()[-2000:]}"
        message = self._answers.pop(number)
        if "display" in message.content and "session" in message.content:
            self.sessions.add(message.content["session"])
        if message.content["type"] == "error":
            raise RequestError(message.content["code"], message.content["text"])
        return message

    def request(self, kind: str, **fields: Any) -> dict[str, Any]:
        return self.wait(self.send(kind, **fields)).content

    def other(self, kind: str, seconds: float = SECONDS) -> Message:
        """The next message of a type that is no answer, taken out."""
        end = time.monotonic() + seconds
        while True:
            for message in self.others:
                if message.content["type"] == kind:
                    self.others.remove(message)
                    return message
            assert self.take(end - time.monotonic()), "the worker ended"

    def frame(self, sizes: dict[str, int], seconds: float = SECONDS) -> Frame:
        return decode(self.other("frame", seconds).body, FrameSizes(**sizes))

    def close_sessions(self) -> None:
        """Closes all sessions, also those of a test that failed."""
        for number in self.sessions:
            try:
                self.request("play.close", session=number)
            except RequestError as error:
                assert error.code == NOT_FOUND  # closed by the test
        self.sessions.clear()
        self.others.clear()

    def close(self) -> int:
        """Closes the pipe and waits for the end: the exit status."""
        assert self.process.stdin is not None
        self.read_on()
        self.process.stdin.close()
        try:
            return self.process.wait(timeout=20)
        finally:
            self.process.kill()  # of a test that failed: this process and no other
            self._log.close()
