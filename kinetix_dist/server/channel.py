"""The one websocket of a page: what a page watches, and what it has to hear of.

Version 1. Text messages, JSON objects with a `type`.

| from the page | |
|---|---|
| `hello {version}` | first; answered by `hello {version, play}` |
| `watch {run, since, revision}` | `since`: rows that the page has, `revision` of these, both from `series` |
| `unwatch {run}` | |

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

from kinetix_dist.dashboard.run_reader import Changes, RunReader
from kinetix_dist.server.run_service import RunService, UnknownRunError

VERSION = 1
MAX_WAITING = 256  # messages for a page that does not read; then it is let go, and comes back
MAX_MESSAGE_BYTES = 4 << 20  # from a page
PING_SECONDS = 20.0


class Channel:
    """One page. Messages wait in a queue, so that a slow page delays no other."""

    def __init__(self, service: RunService, *, has_play: bool) -> None:
        self._service = service
        self._has_play = has_play
        self._socket = web.WebSocketResponse(heartbeat=PING_SECONDS, max_msg_size=MAX_MESSAGE_BYTES, compress=True)
        self._waiting: asyncio.Queue[str] = asyncio.Queue(MAX_WAITING)

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """Until the page goes."""
        await self._socket.prepare(request)
        sender = asyncio.create_task(self._send())
        try:
            async for message in self._socket:
                if message.type == WSMsgType.TEXT:
                    await self._hear(message.data)
        finally:
            self._service.unwatch(self)
            sender.cancel()
        return self._socket

    async def close(self) -> None:
        await self._socket.close()

    def changed(self, run_id: str, reader: RunReader, changes: Changes) -> None:
        """A `run_service.Watcher`."""
        if changes.rewound_to is not None:
            self.say("rewound", run=run_id, revision=reader.revision, to_update=changes.rewound_to)
        if changes.first_row is not None:
            self._say_rows(run_id, reader, changes.first_row)
        if changes.events or changes.events_restarted:
            self.say("events", run=run_id, restarted=changes.events_restarted, events=changes.events)
        self.say("problems", run=run_id, problems=list(reader.problems.values()))

    def read(self, run_id: str, bytes_left: int) -> None:
        """A `run_service.Watcher`."""
        self.say("reading", run=run_id, bytes_left=bytes_left)

    def say(self, kind: str, **fields: Any) -> None:
        """Puts a message in the queue; a page that does not read is let go."""
        try:
            self._waiting.put_nowait(json.dumps({"type": kind, **fields}, allow_nan=False))
        except asyncio.QueueFull:
            asyncio.get_running_loop().create_task(self.close())

    def _say_rows(self, run_id: str, reader: RunReader, first: int) -> None:
        with reader.lock:
            columns = reader.table.rows(first)
        self.say("rows", run=run_id, revision=reader.revision, first=first, columns=columns)

    async def _send(self) -> None:
        while True:
            await self._socket.send_str(await self._waiting.get())

    async def _hear(self, text: str) -> None:
        try:
            message = json.loads(text)
            await self._obey(message["type"], message)
        except (ValueError, KeyError, TypeError) as error:
            self.say("error", text=f"the message is not understood ({type(error).__name__}: {error})")
        except UnknownRunError as error:
            self.say("error", text=str(error))

    async def _obey(self, kind: str, message: dict[str, Any]) -> None:
        if kind == "hello":
            if message["version"] != VERSION:
                self.say("error", text=f"the page speaks version {message['version']}, the server {VERSION}: reload it")
            self.say("hello", version=VERSION, play=self._has_play)
        elif kind == "watch":
            await self._watch(message["run"], int(message.get("since", 0)), message.get("revision"))
        elif kind == "unwatch":
            self._service.unwatch(self, message["run"])
        else:
            raise ValueError(f"unknown type {kind!r}")

    async def _watch(self, run_id: str, since: int, revision: int | None) -> None:
        self._service.path_of(run_id)
        self._service.watch(run_id, self)
        reader = await self._service.reader(run_id)
        if revision != reader.revision and since:
            self.say("rewound", run=run_id, revision=reader.revision, to_update=0)
            since = 0
        if since < reader.table.num_rows:
            self._say_rows(run_id, reader, since)
