"""Play over the channel of a page: its sessions in the engine worker, their frames, and attempts.

Messages are those of docs/play_protocol.md, with three differences: runs are named by their id instead of a path, the
page chooses the `id` of its requests (any text), and it is answered with that. Frames are binary messages as they are.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

from kinetix_dist.studio.server.level_pages import recording_path
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.worker_client import WorkerClient, WorkerError
from kinetix_dist.studio.worker.wire import Message

REQUESTS = (
    "play.open",
    "play.control",
    "play.close",
    "attempts",
    "check",
    "display",
    "document",
    "convert",
    "mutate",
    "generate",
    "mechanism",
)
MAX_REQUESTS = 32  # of one page at a time


class PlayChannel:
    """Sessions and requests of one page. `send(content)` and `send_frame(bytes)` must not wait."""

    def __init__(
        self,
        service: RunService,
        worker: WorkerClient,
        send: Callable[[dict[str, Any]], None],
        send_frame: Callable[[bytes], None],
    ) -> None:
        self._service = service
        self._worker = worker
        self._send = send
        self._send_frame = send_frame
        self._sessions: set[int] = set()
        self._requests: dict[str, asyncio.Task[None]] = {}

    async def on_message(self, kind: str, message: dict[str, Any]) -> bool:
        """Handles a message of play; False for any other. Raises LookupError or TypeError for malformed ones."""
        if kind == "play.input":
            if message["session"] in self._sessions:
                await self._worker.send(kind, {name: message[name] for name in ("session", "seq", "action")})
        elif kind == "cancel":
            if (task := self._requests.get(str(message["id"]))) is not None:
                task.cancel()
        elif kind in REQUESTS:
            self._begin(kind, message)
        else:
            return False
        return True

    async def close(self) -> None:
        """Ends what the page began."""
        for task in list(self._requests.values()):
            task.cancel()
        for session in list(self._sessions):
            self._worker.unsubscribe(session)
            with contextlib.suppress(WorkerError):  # the worker is gone, and the session with it
                await self._worker.request("play.close", {"session": session})
        self._sessions.clear()

    def _begin(self, kind: str, message: dict[str, Any]) -> None:
        number = str(message["id"])
        if number in self._requests or len(self._requests) >= MAX_REQUESTS:
            raise KeyError(f"id {number} is in use, or more than {MAX_REQUESTS} requests wait")
        fields = {name: value for name, value in message.items() if name not in ("type", "id")}
        if "session" in fields and fields["session"] not in self._sessions:
            raise LookupError(f"session {fields['session']} is not of this page")
        for name in ("level", "policy", "env"):
            if isinstance(fields.get(name), dict):
                fields[name] = self._with_path(fields[name])
        self._requests[number] = asyncio.create_task(self._answer(number, kind, fields))

    async def _answer(self, number: str, kind: str, fields: dict[str, Any]) -> None:
        def progress(content: dict[str, Any]) -> None:
            self._send({**content, "type": "progress", "id": number})

        try:
            reply = await self._worker.request(kind, fields, progress)
            if kind == "play.open":
                self._sessions.add(reply.content["session"])
                await self._worker.subscribe(reply.content["session"], self._forward)
            elif kind == "play.close":
                self._worker.unsubscribe(fields["session"])
                self._sessions.discard(fields["session"])
            self._send({**reply.content, "type": "reply", "id": number})
        except WorkerError as error:
            self._send({"type": "error", "id": number, "code": error.code, "text": str(error)})
        finally:
            self._requests.pop(number, None)

    def _forward(self, message: Message) -> None:
        if message.content["type"] == "frame":
            self._send_frame(message.body)
        else:
            if message.content["type"] == "error":
                self._sessions.discard(message.content["session"])
            self._send(message.content)

    def _with_path(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Fields with the path of a run instead of its id. Raises LookupError for a checkpoint named by a path."""
        found = dict(fields)
        if "run" in found:
            found["run"] = str(self._service.path_of(str(found["run"])))
        if "recording" in found:
            run = self._service.path_of(str(found.pop("of_run")))
            found["recording"] = str(recording_path(run, str(found["recording"])))
        if "checkpoint" in found and (not isinstance(found["checkpoint"], str) or "/" in found["checkpoint"]):
            raise LookupError("a checkpoint is named by its run, or by the name of a pretrained policy")
        return found
