"""Messages over the pipe: what is sent is what is read, cut and damaged ones are said, the next one is read."""

from __future__ import annotations

import io
import math
import struct

import numpy as np
import pytest

from kinetix_dist.studio.worker import wire
from kinetix_dist.studio.worker.wire import Message, ProtocolError


def test_a_message_comes_back_with_its_body() -> None:
    first, second = Message({"type": "a", "text": "ü"}, b"\0\1\2"), Message({"type": "b"})
    pipe = io.BytesIO(wire.encode(first) + wire.encode(second))
    assert wire.read(pipe) == first
    assert wire.read(pipe) == second
    assert wire.read(pipe) is None


def test_bytes_are_those_of_the_documentation() -> None:
    data = wire.encode(Message({"type": "x"}, b"body"))
    assert data == struct.pack("<II", 4 + 12 + 4, 12) + b'{"type":"x"}' + b"body"


def test_every_cut_of_a_message_is_the_end_of_the_pipe() -> None:
    data = wire.encode(Message({"type": "a"}, b"body"))
    for length in range(len(data)):
        assert wire.read(io.BytesIO(data[:length])) is None


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<I", 2) + b"xx",  # too short for the size of the JSON
        struct.pack("<II", 6, 100) + b"{}",  # longer JSON than there is
        struct.pack("<II", 6, 2) + b"[]",
        struct.pack("<II", 6, 2) + b"{}",  # no type
        struct.pack("<II", 6, 2) + b"\xff\xff",
        struct.pack("<II", 4 + 5000, 5000) + b"[" * 5000,
    ],
)
def test_what_is_no_message_is_one_line_and_the_next_one_is_read(data: bytes) -> None:
    pipe = io.BytesIO(data + wire.encode(Message({"type": "next"})))
    with pytest.raises(ProtocolError) as error:
        wire.read(pipe)
    assert error.value.code == wire.BAD_REQUEST and "\n" not in str(error.value)
    assert wire.read(pipe) == Message({"type": "next"})


def test_a_message_that_is_too_large_is_skipped() -> None:
    size = wire.MAX_MESSAGE_BYTES + 1
    pipe = io.BytesIO(struct.pack("<I", size) + bytes(size) + wire.encode(Message({"type": "next"})))
    with pytest.raises(ProtocolError) as error:
        wire.read(pipe)
    assert error.value.code == wire.TOO_LARGE
    assert wire.read(pipe) == Message({"type": "next"})


def test_numbers_that_json_has_not_are_never_sent() -> None:
    with pytest.raises(ValueError):
        wire.encode(Message({"type": "a", "x": math.nan}))


def test_random_bytes_never_raise_anything_else() -> None:
    draws = np.random.default_rng(0)
    for _ in range(300):
        pipe = io.BytesIO(struct.pack("<I", int(draws.integers(0, 40))) + draws.bytes(40))
        try:
            wire.read(pipe)
        except ProtocolError as error:
            assert str(error)
