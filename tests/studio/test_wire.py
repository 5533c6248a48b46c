"""Messages over the pipe: what is sent is what is read, cut and damaged ones are said, the next one is read."""

from __future__ import annotations

import io
import math
import os
import struct
import threading
import time
from typing import IO

import numpy as np
import pytest

from kinetix_dist.studio.worker import wire
from kinetix_dist.studio.worker.wire import Message, Outbox, ProtocolError, read


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


LARGE = bytes(1 << 20)  # a pipe holds 64 kB


def pipe() -> tuple[IO[bytes], IO[bytes]]:
    reading, writing = os.pipe()
    return os.fdopen(reading, "rb"), os.fdopen(writing, "wb")


def read_all(reading: IO[bytes]) -> list[Message]:
    messages = []
    while (message := read(reading)) is not None:
        messages.append(message)
    return messages


def test_a_slow_client_gets_all_replies_in_order_and_the_newest_frames() -> None:
    reading, writing = pipe()
    outbox = Outbox(writing)
    outbox.send({"type": "reply", "id": 0}, LARGE)  # fills the pipe
    time.sleep(0.1)
    for step in range(100):
        outbox.send_frame(1, bytes([1, step]))
        outbox.send_frame(2, bytes([2, step]))
        if step % 50 == 25:
            outbox.send({"type": "play.end", "session": 1, "step": step})
    outbox.send({"type": "reply", "id": 1})
    closing = threading.Thread(target=lambda: (outbox.close(10), writing.close()))
    closing.start()
    messages = read_all(reading)
    closing.join()
    frames = [message.body for message in messages if message.content["type"] == "frame"]
    assert len(frames) == 200 - outbox.num_dropped
    assert len(frames) < 10
    for session in (1, 2):
        steps = [frame[1] for frame in frames if frame[0] == session]
        assert steps == sorted(steps) and steps[-1] == 99
    # A message of a session follows the frame that it is about.
    kinds = [(message.content["type"], message.body[1:2], message.content.get("step")) for message in messages]
    for step in (25, 75):
        assert kinds.index(("frame", bytes([step]), None)) + 1 == kinds.index(("play.end", b"", step))
    assert [message.content["id"] for message in messages if message.content["type"] == "reply"] == [0, 1]


def test_a_client_that_is_gone_ends_the_writing() -> None:
    reading, writing = pipe()
    outbox = Outbox(writing)
    reading.close()
    outbox.send({"type": "reply", "id": 0}, LARGE)
    outbox.close(5)
    assert not outbox._thread.is_alive()


def test_frames_of_a_closed_session_are_forgotten() -> None:
    reading, writing = pipe()
    outbox = Outbox(writing)
    outbox.send({"type": "reply", "id": 0}, LARGE)
    time.sleep(0.1)
    outbox.send_frame(1, b"x")
    outbox.discard_frames(1)
    closing = threading.Thread(target=lambda: (outbox.close(10), writing.close()))
    closing.start()
    assert [message.content["type"] for message in read_all(reading)] == ["reply"]
    closing.join()
