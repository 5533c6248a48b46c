"""A sink of rows in a thread of its own, so that no file can stall or end training.

    trainer --write(row)--> [queue, bounded] --> thread --> sink --> file

| who    | consumes        | waits for                      | when it cannot go on                          |
|--------|-----------------|--------------------------------|-----------------------------------------------|
| write  | a row           | the file, `patience_s` at most | queue full: row dropped, counted              |
|        |                 | and while the sink is well     |                                               |
| thread | rows of a queue | the queue, the disk            | any error: row dropped, counted; the next row |
|        |                 |                                | opens the sink again                          |

While all is well a row is in the file when `write` returns, unless `patience_s` is 0. One
`sink_failing` is reported when rows begin to be dropped or to wait, one `sink_recovered` when a row gets through again.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar

from kinetix_dist.errors import one_line

PATIENCE_S = 1.0  # for a disk that is slow; one that hangs costs this once
QUEUE_ROWS = 256  # about 1 MB of rows; a disk that hangs for longer loses the rest
CLOSE_S = 5.0  # for what is queued at the end


Row = TypeVar("Row")
WrittenRow = TypeVar("WrittenRow", contravariant=True)


class RowSink(Protocol[WrittenRow]):
    """Whatever writes rows (of metrics, say), and raises where it cannot."""

    def write(self, update: int, row: WrittenRow, /) -> None: ...

    def close(self) -> None: ...


Tell = Callable[[str, dict[str, Any]], None]


class BackgroundSink(Generic[Row]):
    """Rows for one `RowSink`. `write` never raises and never waits for long."""

    def __init__(
        self,
        name: str,
        open_sink: Callable[[], RowSink[Row]],
        tell: Tell,
        *,
        patience_s: float = PATIENCE_S,
        max_queued: int = QUEUE_ROWS,
        opens_at_once: bool = False,
    ) -> None:
        """open_sink: called in the thread, before the first row (or now) and again after every failure.
        `tell(event, details)` is called from either thread. patience_s: that `write` waits for its row; max_queued:
        rows that wait at most."""
        self._name = name
        self._open_sink = open_sink
        self._tell = tell
        self._patience_s = patience_s
        self._max_queued = max_queued
        self._opens_at_once = opens_at_once
        self._queue: queue.Queue[tuple[int, Row, threading.Event] | None] = queue.Queue(maxsize=max_queued)
        self._lock = threading.Lock()
        self._dropped = 0
        self._dropped_before = 0  # when the present trouble began
        self._is_failing = False
        self._thread = self._begin()

    @property
    def num_dropped(self) -> int:
        """Rows that were given up."""
        with self._lock:
            return self._dropped

    def write(self, update: int, row: Row) -> None:
        if not self._thread.is_alive():
            self._drop("the thread that writes has ended", 1)  # with the row that it was at
            self._thread = self._begin()
        done = threading.Event()
        try:
            self._queue.put_nowait((update, row, done))
        except queue.Full:
            self._drop(f"{self._max_queued} rows wait: the disk hangs, or is slower than training", 1)
            return
        if not self._patience_s or self._is_failing:
            return
        if not done.wait(self._patience_s) and self._thread.is_alive():
            self._drop(f"a row was not written within {self._patience_s:g} s", 0)

    def close(self) -> None:
        """Writes what is queued, for CLOSE_S at most; what is left is dropped and counted."""
        close_sinks([self])

    def _end(self, deadline: float) -> None:
        """deadline: of time.monotonic()."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=max(deadline - time.monotonic(), 0.0))
        self._thread.join(max(deadline - time.monotonic(), 0.0))
        if left := sum(row is not None for row in list(self._queue.queue)):
            self._drop(f"the last rows were not written within {CLOSE_S:g} s", left)

    def _begin(self) -> threading.Thread:
        # A daemon: a disk that hangs must not keep a finished process alive.
        thread = threading.Thread(target=self._work, name=f"sink {self._name}", daemon=True)
        thread.start()
        return thread

    def _work(self) -> None:
        sink = self._opened() if self._opens_at_once else None
        while (queued := self._queue.get()) is not None:
            update, row, done = queued
            try:
                sink = sink or self._open_sink()
                sink.write(update, row)
            except Exception as error:  # whatever it is, training goes on and hears of it
                self._drop(one_line(error), 1)
                _close(sink)
                sink = None
            else:
                self._got_through()
            finally:
                done.set()
        _close(sink)

    def _opened(self) -> RowSink[Row] | None:
        """None where that fails: the first row tries again."""
        try:
            return self._open_sink()
        except Exception as error:
            self._drop(one_line(error), 0)
            return None

    def _drop(self, reason: str, num_rows: int) -> None:
        with self._lock:
            is_new = not self._is_failing
            if is_new:
                self._is_failing, self._dropped_before = True, self._dropped
            self._dropped += num_rows
        if is_new:
            self._tell("sink_failing", {"sink": self._name, "error": reason})

    def _got_through(self) -> None:
        with self._lock:
            was_failing, self._is_failing = self._is_failing, False
            dropped = self._dropped - self._dropped_before
        if was_failing:
            self._tell("sink_recovered", {"sink": self._name, "dropped": dropped})


def close_sinks(sinks: Sequence[BackgroundSink[Any]]) -> None:
    """Closes several: CLOSE_S is for all of them together, since they share a disk."""
    deadline = time.monotonic() + CLOSE_S
    for sink in sinks:
        sink._end(deadline)


def _close(sink: RowSink[Any] | None) -> None:
    """Closes a sink. One that failed may fail at closing too; that has been reported already."""
    if sink is not None:
        with contextlib.suppress(Exception):
            sink.close()
