"""Writing thread: messages stay in order, replies are never lost, a slow client loses frames and nothing else."""

from __future__ import annotations

import os
import threading
import time
from typing import IO

from kinetix_dist.studio.worker.wire import Message, Outbox, read

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
