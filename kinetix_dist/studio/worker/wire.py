"""Messages over the pipe between a server and the engine worker (docs/play_protocol.md). No jax: both sides import it.

u32 size of all that follows | u32 size of the JSON | JSON object, UTF-8 | body
"""

from __future__ import annotations

import collections
import dataclasses
import json
import struct
import threading
from typing import IO, Any

PROTOCOL_VERSION = 1
MAX_MESSAGE_BYTES = 64 << 20
_HEAD = struct.Struct("<I")
_SKIPPED_AT_ONCE = 1 << 20

# Codes of errors.
BAD_REQUEST, NOT_FOUND, TOO_LARGE, BUSY, CANCELLED, FAILED = (
    "bad_request",
    "not_found",
    "too_large",
    "busy",
    "cancelled",
    "failed",
)


class RequestError(Exception):
    """Error reply to a request: a code and one line."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class ProtocolError(ValueError):
    """Bytes that are no message. The pipe can be read on: the message was skipped."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclasses.dataclass(frozen=True)
class Message:
    """Message: a JSON object with a `type`, and a body of bytes."""

    content: dict[str, Any]
    body: bytes = b""


def encode(message: Message) -> bytes:
    """Bytes of a message. Raises ValueError for numbers that are not finite, which JSON does not have."""
    text = json.dumps(message.content, allow_nan=False, separators=(",", ":")).encode()
    size = _HEAD.size + len(text) + len(message.body)
    return b"".join((_HEAD.pack(size), _HEAD.pack(len(text)), text, message.body))


def decode(data: bytes) -> Message:
    """Message of the bytes that follow its size. Raises ProtocolError."""
    if len(data) < _HEAD.size:
        raise ProtocolError(BAD_REQUEST, f"a message of {len(data)} bytes is none; see docs/play_protocol.md")
    (length,) = _HEAD.unpack_from(data)
    if length > len(data) - _HEAD.size:
        raise ProtocolError(BAD_REQUEST, f"a message of {len(data)} bytes cannot hold {length} bytes of JSON")
    text = data[_HEAD.size : _HEAD.size + length]
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:  # also what is not UTF-8
        raise ProtocolError(BAD_REQUEST, f"a message is not JSON ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict) or not isinstance(content.get("type"), str):
        raise ProtocolError(BAD_REQUEST, 'a message is no JSON object with a "type"')
    return Message(content, data[_HEAD.size + length :])


def read(pipe: IO[bytes]) -> Message | None:
    """Next message; None at the end of the pipe, also in the middle of a message. Raises ProtocolError."""
    head = _read_exactly(pipe, _HEAD.size)
    if head is None:
        return None
    (size,) = _HEAD.unpack(head)
    if size > MAX_MESSAGE_BYTES:
        if not _skip(pipe, size):
            return None
        raise ProtocolError(
            TOO_LARGE, f"a message has {size} bytes; at most {MAX_MESSAGE_BYTES} are read: send something smaller"
        )
    data = _read_exactly(pipe, size)
    return None if data is None else decode(data)


def _read_exactly(pipe: IO[bytes], size: int) -> bytes | None:
    parts, missing = [], size
    while missing:
        part = pipe.read(missing)
        if not part:
            return None
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def _skip(pipe: IO[bytes], size: int) -> bool:
    """Skips bytes; False where the pipe ended before."""
    while size:
        part = pipe.read(min(size, _SKIPPED_AT_ONCE))
        if not part:
            return False
        size -= len(part)
    return True


class Outbox:
    """Thread that writes messages in order, and of frames only the newest of each session.

    Consumes: messages of any thread. Produces: bytes into the pipe. Waits for: the client that reads.
    Replies are never dropped; there are no more of them than requests. A frame that waits while the pipe is full is
    replaced by the next one of its session: a slow client loses steps, not their order, and delays no other session.
    Other messages of a session follow its frame.
    """

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
        """Queues any message but a frame; one of a session follows its waiting frame."""
        data = encode(Message(content, body))
        with self._condition:
            waiting = self._frames.pop(content.get("session", 0), None)
            if waiting is not None:
                self._messages.append(encode(waiting))
            self._messages.append(data)
            self._condition.notify()

    def send_frame(self, session: int, frame: bytes) -> None:
        """Queues a frame in the place of one of its session that still waits."""
        with self._condition:
            if session in self._frames:
                self.num_dropped += 1
            self._frames[session] = Message({"type": "frame", "session": session}, frame)
            self._condition.notify()

    def discard_frames(self, session: int) -> None:
        """Drops the waiting frame of a session that is closed."""
        with self._condition:
            self._frames.pop(session, None)

    def close(self, seconds: float) -> None:
        """Sends waiting messages, for `seconds` at most."""
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
        """Next bytes to write, None at the end. Waits for a message."""
        with self._condition:
            self._condition.wait_for(lambda: self._messages or self._frames or self._is_closed)
            if self._messages:
                return self._messages.popleft()
            if self._frames:
                return encode(self._frames.pop(next(iter(self._frames))))
            return None
