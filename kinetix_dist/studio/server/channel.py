"""The one websocket of a page: it names the runs that it watches, and is notified of their changes.

Version 1. Text messages, JSON objects with a `type`.

| from the page | |
|---|---|
| `hello {version}` | first; answered by `hello {version, play}` |
| `watch {run, since, revision}` | `since`: rows it has, of `revision` (see `series`); null: new ones only |
| `unwatch {run}` | |
| `play.open`, `play.input`, ... | see play_channel.py |

| to the page | |
|---|---|
| `rows {run, revision, first, columns}` | rows of metrics from number `first` on, {name: [numbers or null]} |
| `rewound {run, revision, to_update}` | rows of later updates are void: the run went back, or its file became another |
| `events {run, restarted, events}` | new events; `restarted`: those before are void |
| `problems {run, problems}` | lines about files that cannot be read as they are |
| `reading {run, bytes_left}` | of a long file that is read for the first time |
| `error {text}` | one line |
"""

from __future__ import annotations

import asyncio
import json
from typing import Any

from aiohttp import WSMsgType, web

from kinetix_dist.errors import one_line
from kinetix_dist.studio.runs.run_reader import Changes, RunReader
from kinetix_dist.studio.server.play_channel import PlayChannel
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.worker_client import WorkerClient
from kinetix_dist.text_files import loads_json

VERSION = 1
MAX_WAITING = 256  # messages for a page that does not read; then it is closed, and reconnects
MAX_MESSAGE_BYTES = 4 << 20  # from a page
PING_SECONDS = 20.0


class Channel:
    """Channel of one page. Messages wait in a queue, so that a slow page delays no other."""

    def __init__(self, service: RunService, worker: WorkerClient, *, has_play: bool) -> None:
        self._service = service
        self._has_play = has_play
        self._socket = web.WebSocketResponse(heartbeat=PING_SECONDS, max_msg_size=MAX_MESSAGE_BYTES, compress=True)
        self._waiting: asyncio.Queue[str | None] = asyncio.Queue(MAX_WAITING)  # None: a frame
        self._frames: dict[int, bytes] = {}  # the newest of each session that waits
        self._play = PlayChannel(service, worker, lambda content: self.send(**content), self._send_frame)

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """Serves the page until it disconnects."""
        await self._socket.prepare(request)
        sender = asyncio.create_task(self._write())
        try:
            async for message in self._socket:
                if message.type == WSMsgType.TEXT:
                    await self._on_message(message.data)
        finally:
            self._service.unwatch(self)
            sender.cancel()
            await self._play.close()
        return self._socket

    async def close(self) -> None:
        await self._socket.close()

    def changed(self, run_id: str, reader: RunReader, changes: Changes) -> None:
        """Notifies the page of changes of a run (`run_service.Watcher`)."""
        if changes.rewound_to is not None:
            self.send("rewound", run=run_id, revision=reader.revision, to_update=changes.rewound_to)
        if changes.first_row is not None:
            self._send_rows(run_id, reader, changes.first_row)
        if changes.events or changes.events_restarted:
            self.send("events", run=run_id, restarted=changes.events_restarted, events=changes.events)
        self.send("problems", run=run_id, problems=list(reader.problems.values()))

    def read(self, run_id: str, bytes_left: int) -> None:
        """Notifies the page how far a first read is (`run_service.Watcher`)."""
        self.send("reading", run=run_id, bytes_left=bytes_left)

    def send(self, type: str, **fields: Any) -> None:
        """Puts a message in the queue; closes the channel of a page that does not read."""
        self._put(json.dumps({"type": type, **fields}, allow_nan=False))

    def _send_frame(self, frame: bytes) -> None:
        """Puts a frame in the queue; it replaces one of its session that still waits."""
        session = int.from_bytes(frame[2:4], "little")
        if session not in self._frames:
            self._put(None)
        self._frames[session] = frame

    def _put(self, message: str | None) -> None:
        try:
            self._waiting.put_nowait(message)
        except asyncio.QueueFull:
            asyncio.get_running_loop().create_task(self.close())

    def _send_rows(self, run_id: str, reader: RunReader, first: int) -> None:
        with reader.lock:
            columns = reader.table.rows(first)
        self.send("rows", run=run_id, revision=reader.revision, first=first, columns=columns)

    async def _write(self) -> None:
        while True:
            message = await self._waiting.get()
            if message is not None:
                await self._socket.send_str(message)
            elif self._frames:
                session = next(iter(self._frames))
                await self._socket.send_bytes(self._frames.pop(session), compress=0)

    async def _on_message(self, text: str) -> None:
        try:
            message = loads_json(text)
            await self._handle(message["type"], message)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            self.send("error", text=one_line(f"the message is not understood ({type(error).__name__}: {error})"))
        except LookupError as error:
            self.send("error", text=one_line(str(error.args[0] if error.args else error)))

    async def _handle(self, kind: str, message: dict[str, Any]) -> None:
        if kind == "hello":
            if message["version"] != VERSION:
                self.send(
                    "error", text=f"the page speaks version {message['version']}, the server {VERSION}: reload it"
                )
            self.send("hello", version=VERSION, play=self._has_play)
        elif kind == "watch":
            since = message.get("since")
            await self._watch(message["run"], None if since is None else int(since), message.get("revision"))
        elif kind == "unwatch":
            self._service.unwatch(self, message["run"])
        elif not await self._play.on_message(kind, message):
            raise ValueError(f"unknown type {kind!r}")

    async def _watch(self, run_id: str, since: int | None, revision: int | None) -> None:
        await self._service.look_for(run_id)
        self._service.path_of(run_id)
        self._service.watch(run_id, self)
        reader = await self._service.reader(run_id)
        if since is None:
            return
        if revision != reader.revision and since:
            self.send("rewound", run=run_id, revision=reader.revision, to_update=0)
            since = 0
        if since < reader.table.num_rows:
            self._send_rows(run_id, reader, since)
