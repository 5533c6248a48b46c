"""Client of the engine worker: starts it when it is first needed, and again after it died; ends it with the server.

    page --HTTP, channel--> WorkerClient.request --pipe--> kinetix_dist.studio.worker.process

The worker ends when its pipe closes, so it goes with the server however that ends. docs/play_protocol.md has the
messages. A worker that is silent about a request for SILENT_SECONDS counts as hung and is killed; the next
request starts another.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
import time
from collections.abc import Callable
from typing import Any

from kinetix_dist.child_python import command_of, difference_of_imports
from kinetix_dist.studio.worker.wire import MAX_MESSAGE_BYTES, PROTOCOL_VERSION, Message, decode, encode

SILENT_SECONDS = 120.0
START_SECONDS = 120.0  # importing jax on a busy machine
END_SECONDS = 3.0
LOG_BYTES = 4096  # of its standard error, for the reason of its end
GONE, HUNG, OFF = "gone", "hung", "off"  # codes of errors that are not the worker's
NO_WORKER = "levels are not drawn or played here: the server was started with --no-play"

WORKER = "kinetix_dist.studio.worker.process"

Progress = Callable[[dict[str, Any]], None]
OnMessage = Callable[[Message], None]


class WorkerError(Exception):
    """Failed request: a code of docs/play_protocol.md or one of the above, and one line."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class WorkerClient:
    """Client of one worker at a time. All methods are called in the event loop."""

    def __init__(self, *, is_allowed: bool = True, command: tuple[str, ...] | None = None) -> None:
        """is_allowed False: no worker is ever started, and every request is refused. command: starts another worker."""
        self._is_allowed = is_allowed
        self._command = command or tuple(command_of(WORKER))
        self._worker: _Worker | None = None
        self._starting = asyncio.Lock()

    @property
    def pid(self) -> int | None:
        """Process id of the running worker; None: none runs."""
        return self._worker.process.pid if self._worker is not None and self._worker.is_alive else None

    @property
    def is_off(self) -> bool:
        """True where no worker may be started."""
        return not self._is_allowed

    async def hello(self) -> dict[str, Any]:
        """First message of the worker: sizes, palette, generators. Starts the worker."""
        return (await self._running()).hello

    async def request(self, kind: str, fields: dict[str, Any], progress: Progress | None = None) -> Message:
        """Reply to a request. Cancelling the caller cancels the request. Raises WorkerError."""
        return await (await self._running()).request(kind, fields, progress)

    async def send(self, kind: str, fields: dict[str, Any]) -> None:
        """Sends a message that has no reply. Does nothing where no worker runs: its sessions are gone."""
        if self._worker is not None and self._worker.is_alive:
            await self._worker.send({"type": kind, **fields})

    async def subscribe(self, session: int, on_message: OnMessage) -> None:
        """Sends frames and the end of a session to `on_message`; an `error` without id when the worker is gone."""
        (await self._running()).sessions[session] = on_message

    def unsubscribe(self, session: int) -> None:
        if self._worker is not None:
            self._worker.sessions.pop(session, None)

    async def close(self) -> None:
        """Ends the worker, if there is one."""
        if self._worker is not None:
            await self._worker.close()

    async def _running(self) -> _Worker:
        if self.is_off:
            raise WorkerError(OFF, NO_WORKER)
        async with self._starting:
            if self._worker is not None and not self._worker.is_alive:
                await self._worker.close()
                self._worker = None
            if self._worker is None:
                self._worker = await _Worker.start(self._command)
            return self._worker


class _Worker:
    """Worker process, from its start to its end."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.hello: dict[str, Any] = {}
        self.sessions: dict[int, OnMessage] = {}
        self._next_id = 1
        self._requests: dict[int, tuple[asyncio.Future[Message], Progress | None]] = {}
        self._last_message_at = time.monotonic()
        self._log = b""
        self._greeting: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._end: WorkerError | None = None
        self._tasks = [asyncio.create_task(task) for task in (self._read(), self._read_log(), self._watch())]

    @classmethod
    async def start(cls, command: tuple[str, ...]) -> _Worker:
        environment = os.environ | {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
        pipe = asyncio.subprocess.PIPE
        try:
            process = await asyncio.create_subprocess_exec(
                *command, stdin=pipe, stdout=pipe, stderr=pipe, env=environment
            )
        except OSError as error:
            raise WorkerError(GONE, f"the engine worker cannot be started ({error.strerror})") from error
        worker = cls(process)
        try:
            await asyncio.wait_for(asyncio.shield(worker._greeting), START_SECONDS)
        except TimeoutError:
            worker._kill(WorkerError(HUNG, f"the engine worker was not ready within {START_SECONDS:g} s; try again"))
            await worker.close()
            raise WorkerError(HUNG, str(worker._end)) from None
        except WorkerError:
            await worker.close()
            raise
        return worker

    @property
    def is_alive(self) -> bool:
        return self._end is None

    async def request(self, kind: str, fields: dict[str, Any], progress: Progress | None) -> Message:
        number = self._next_id
        self._next_id += 1
        reply: asyncio.Future[Message] = asyncio.get_running_loop().create_future()
        self._requests[number] = (reply, progress)
        self._last_message_at = time.monotonic()
        try:
            await self.send({**fields, "type": kind, "id": number})
            return await reply
        except asyncio.CancelledError:
            if self.is_alive:
                await self.send({"type": "cancel", "id": number})
            raise
        finally:
            self._requests.pop(number, None)

    async def send(self, content: dict[str, Any]) -> None:
        if self._end is not None:
            raise self._end
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(encode(Message(content)))
            await self.process.stdin.drain()
        except (ConnectionError, OSError):
            pass  # `_read` sees its end, and fails all requests with the reason

    async def close(self) -> None:
        self._ended(WorkerError(GONE, "the server ends"))
        assert self.process.stdin is not None
        self.process.stdin.close()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.process.wait(), END_SECONDS)
        if self.process.returncode is None:
            self.process.kill()
            await self.process.wait()
        for task in self._tasks:
            task.cancel()

    async def _read(self) -> None:
        assert self.process.stdout is not None
        try:
            while True:
                (size,) = struct.unpack("<I", await self.process.stdout.readexactly(4))
                if size > MAX_MESSAGE_BYTES:
                    raise ValueError(f"a message of {size} bytes")
                self._on_message(decode(await self.process.stdout.readexactly(size)))
        except (asyncio.IncompleteReadError, ConnectionError):
            status = await self.process.wait()
            if status == 0:
                self._ended(WorkerError(GONE, "the engine worker ended, since it had no requests; try again"))
            else:
                last = self._log.decode(errors="replace").strip().splitlines()[-1:]
                why = f": {last[0]}" if last and status > 0 else ""  # a killed one has logged no reason
                self._ended(WorkerError(GONE, f"the engine worker died (exit status {status}){why}; try again"))
        except ValueError as error:
            self._kill(WorkerError(GONE, f"the engine worker sent something that is no message ({error})"))

    async def _read_log(self) -> None:
        assert self.process.stderr is not None
        while part := await self.process.stderr.read(LOG_BYTES):
            self._log = (self._log + part)[-LOG_BYTES:]

    async def _watch(self) -> None:
        while self.is_alive:
            await asyncio.sleep(min(1.0, SILENT_SECONDS / 4))
            if self._requests and time.monotonic() - self._last_message_at > SILENT_SECONDS:
                text = f"the engine worker was silent for {SILENT_SECONDS:g} s and was ended; try again"
                self._kill(WorkerError(HUNG, text))

    def _on_message(self, message: Message) -> None:
        content = message.content
        self._last_message_at = time.monotonic()
        kind, number = content["type"], content.get("id")
        if kind == "hello":
            self._greet(content)
        elif "session" in content and number is None:
            if (on_message := self.sessions.get(content["session"])) is not None:
                on_message(message)
        elif number in self._requests:
            reply, progress = self._requests[number]
            if kind == "progress":
                if progress is not None:
                    progress(content)
            elif not reply.done():
                if kind == "error":
                    reply.set_exception(WorkerError(content["code"], content["text"]))
                else:
                    reply.set_result(message)

    def _greet(self, content: dict[str, Any]) -> None:
        if content.get("version") != PROTOCOL_VERSION:
            text = f"the engine worker speaks version {content.get('version')}, the server {PROTOCOL_VERSION}"
            self._kill(WorkerError(GONE, f"{text}: start the server again"))
            return
        if differ := difference_of_imports(content["imports"]):
            self._kill(WorkerError(GONE, f"the engine worker imports {differ}: start the server again"))
            return
        self.hello = content
        self._greeting.set_result(None)

    def _kill(self, error: WorkerError) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        self._ended(error)

    def _ended(self, error: WorkerError) -> None:
        """Fails all requests and sessions with the error, once."""
        if self._end is not None:
            return
        self._end = error
        for reply, _ in self._requests.values():
            if not reply.done():
                reply.set_exception(WorkerError(error.code, str(error)))
        for session, on_message in self.sessions.items():
            on_message(Message({"type": "error", "session": session, "code": error.code, "text": str(error)}))
        self.sessions.clear()
        if not self._greeting.done():
            self._greeting.set_exception(error)
