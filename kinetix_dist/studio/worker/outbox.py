"""What a worker sends: a thread that writes messages in order, and of frames only the newest a client has room for.

Replies are never dropped; there are no more of them than requests. A frame that waits while the pipe is full is
replaced by the next one of its session, so that a slow client loses steps, not their order, and delays nobody. What
else a session has to say waits for its frame.
"""

from __future__ import annotations

import collections
import threading
from typing import IO, Any

from kinetix_dist.studio.worker.wire import Message, encode


class Outbox:
    """Consumes: messages of any thread. Produces: bytes into the pipe. Waits for: the client that reads."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._condition = threading.Condition()
        self._messages: collections.deque[bytes] = collections.deque()
        self._frames: dict[int, Message] = {}
        self._is_closed = False
        self.num_dropped = 0
        self._thread = threading.Thread(target=self._write, name="outbox", daemon=True)
        self._thread.start()

    def send(self, content: dict[str, Any], body: bytes = b"") -> None:
        """Any message but a frame. Of a session: after the frame of it that waits."""
        data = encode(Message(content, body))
        with self._condition:
            waiting = self._frames.pop(content.get("session", 0), None)
            if waiting is not None:
                self._messages.append(encode(waiting))
            self._messages.append(data)
            self._condition.notify()

    def send_frame(self, session: int, frame: bytes) -> None:
        with self._condition:
            if session in self._frames:
                self.num_dropped += 1
            self._frames[session] = Message({"type": "frame", "session": session}, frame)
            self._condition.notify()

    def forget(self, session: int) -> None:
        """No more frames of a session that is closed."""
        with self._condition:
            self._frames.pop(session, None)

    def close(self, seconds: float) -> None:
        """Sends what waits, for so long at most."""
        with self._condition:
            self._is_closed = True
            self._condition.notify()
        self._thread.join(seconds)

    def _write(self) -> None:
        try:
            while (data := self._next()) is not None:
                self._pipe.write(data)
                self._pipe.flush()
        except (BrokenPipeError, ValueError):  # the client is gone, or the pipe closed: the reader ends the worker
            return

    def _next(self) -> bytes | None:
        """The next bytes to write, None at the end. Waits for some."""
        with self._condition:
            self._condition.wait_for(lambda: self._messages or self._frames or self._is_closed)
            if self._messages:
                return self._messages.popleft()
            if self._frames:
                return encode(self._frames.pop(next(iter(self._frames))))
            return None
