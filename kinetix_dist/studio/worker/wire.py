"""Messages over the pipe between a server and the engine worker (docs/play_protocol.md). No jax: both sides import it.

u32 size of all that follows | u32 size of the JSON | JSON object, UTF-8 | body
"""

from __future__ import annotations

import dataclasses
import json
import struct
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
    """What a request is answered with that cannot be done: a code and one line."""

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
    """One message: a JSON object with a `type`, and bytes that go with it."""

    content: dict[str, Any]
    body: bytes = b""


def encode(message: Message) -> bytes:
    """The bytes of a message. Raises ValueError for numbers that are not finite, which JSON does not have."""
    text = json.dumps(message.content, allow_nan=False, separators=(",", ":")).encode()
    size = _HEAD.size + len(text) + len(message.body)
    return b"".join((_HEAD.pack(size), _HEAD.pack(len(text)), text, message.body))


def decode(data: bytes) -> Message:
    """The message of what follows its size. Raises ProtocolError."""
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
    """The next message; None at the end of the pipe, also in the middle of a message. Raises ProtocolError."""
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
    """Whether there was as much to skip."""
    while size:
        part = pipe.read(min(size, _SKIPPED_AT_ONCE))
        if not part:
            return False
        size -= len(part)
    return True
