"""SIGTERM and Ctrl-C: a run finishes its update, saves and ends; a second signal ends it at once.

    signal --> handler (main thread): notes it; outside of an update it raises StopRequested
           \\-> wakeup pipe --> thread: the time limit, and the second signal

The thread is there because Python calls handlers only between instructions of the main thread, which may be inside a
compilation for minutes.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType
from typing import Any

EXIT_STOPPED = 75  # sysexits.h EX_TEMPFAIL, "try again later": the run can go on with --resume
_SIGNALS = (signal.SIGTERM, signal.SIGINT)
_SWALLOWING = ("_xla_gc_callback", "__del__")  # the first is JAX's
_AGAIN_S = 0.05
_SAME_S = 0.2  # timeout(1) sends its signal to the process and then to its group: that is one
_SHOW_CURSOR = "\x1b[?25h"  # the live line of the console hides it


class StopRequested(BaseException):
    """Raised in the main thread by the first signal, where nothing would be lost by it."""


class StoppedError(Exception):
    """The run ended because a stop was requested: after which update, and how to go on."""


class StopFailedError(Exception):
    """The same, and its last update could not be saved."""


@contextmanager
def raised_through_extensions() -> Generator[None]:
    """StopRequested where an extension, in which a handler raised it, gives an error of its own for it, as Ray's do."""
    try:
        yield
    except SystemError as error:
        if isinstance(error.__cause__, StopRequested):
            raise StopRequested from error
        raise


class StopSignals:
    """Use it as a context in the main thread; elsewhere, and outside of the context, nothing is ever requested."""

    def __init__(self, *, limit_s: float = 25.0, hint: str = "") -> None:
        """limit_s: after which the process ends, wherever it is; hint: how to go on, for the line that is said then."""
        self._limit_s = limit_s
        self.hint = hint
        self.reached = "where it was"  # for the same line: after what the process ended
        self._is_deferred = False
        self._former: dict[int, Any] = {}
        self._pipe: tuple[int, int] | None = None
        self.requested: str | None = None  # name of the first signal

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is not threading.main_thread():
            return self
        self._former = {number: signal.getsignal(number) for number in (*_SIGNALS, signal.SIGALRM)}
        self._pipe = os.pipe()
        os.set_blocking(self._pipe[1], False)
        signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(self._pipe[0],), name="stop signals", daemon=True).start()
        self.install()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._pipe is None:
            return
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in self._former.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(-1)
        os.close(self._pipe[1])  # ends the thread
        self._pipe = None

    def install(self) -> None:
        """Takes the signals; again after `ray.init`, which takes SIGTERM for itself."""
        if self._pipe is not None:
            for number in _SIGNALS:
                signal.signal(number, self._handle)
            signal.signal(signal.SIGALRM, self._again)

    @contextmanager
    def deferred(self) -> Generator[None]:
        """Finishes the block first: a signal inside raises after it."""
        with self._deferring(True):
            yield

    @contextmanager
    def interruptible(self) -> Generator[None]:
        """A wait inside of what is deferred, at which nothing is lost."""
        with self._deferring(False):
            self.raise_if_requested()
            with raised_through_extensions():
                yield

    def raise_if_requested(self) -> None:
        """Raises StopRequested, also where signals are deferred: nothing is lost here by it."""
        if self.requested is not None:
            raise StopRequested

    @contextmanager
    def _deferring(self, is_deferred: bool) -> Generator[None]:
        before, self._is_deferred = self._is_deferred, is_deferred
        try:
            yield
        finally:
            self._is_deferred = before

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested is None:
            self.requested = signal.Signals(number).name
            self._raise_unless_deferred(frame)

    def _again(self, number: int, frame: FrameType | None) -> None:
        del number
        self._raise_unless_deferred(frame)

    def _raise_unless_deferred(self, frame: FrameType | None) -> None:
        if self._is_deferred:
            return
        if _is_swallowed(frame):
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
            return
        raise StopRequested

    def _watch(self, pipe: int) -> None:
        """Ends the process at the second signal, or when the time after the first is over."""
        timer: threading.Timer | None = None
        began = 0.0
        with os.fdopen(pipe, "rb", buffering=0) as numbers:
            while byte := numbers.read(1):
                if byte[0] not in _SIGNALS:
                    continue
                if timer is not None and time.monotonic() - began < _SAME_S:
                    continue
                if timer is not None:
                    _end(128 + byte[0], "ended at once by a second signal")
                began = time.monotonic()
                timer = threading.Timer(self._limit_s, self._reach_limit, (signal.Signals(byte[0]).name,))
                timer.daemon = True
                timer.start()
        if timer is not None:
            timer.cancel()

    def _reach_limit(self, name: str) -> None:
        _end(EXIT_STOPPED, f"not done {self._limit_s:g} s after {name}: ended {self.reached}{self.hint}")


def _is_swallowed(frame: FrameType | None) -> bool:
    """Says whether Python would print what is raised in this frame and go on: callbacks of the garbage collector."""
    while frame is not None:
        if frame.f_code.co_name in _SWALLOWING:
            return True
        frame = frame.f_back
    return False


def _end(status: int, text: str) -> None:
    """Without the usual end of Python: threads, Ray and JAX may hang. The watchdog ends Ray's processes."""
    cursor = _SHOW_CURSOR if sys.stderr.isatty() else ""
    os.write(2, f"{cursor}\nkinetix-dist: {text}\n".encode())
    os._exit(status)
