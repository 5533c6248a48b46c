"""Real-time loop of sessions: one thread that runs commands of clients in their order, and steps that are due.

Consumes: commands of the worker's other threads. Produces: frames and answers (outbox). Waits for: the next step that
is due, or a command. A command may wait for something that another thread prepares (a policy that is loaded): its
session waits, the others go on.
"""

from __future__ import annotations

import collections
import dataclasses
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from kinetix_dist.studio.worker.session import Session
from kinetix_dist.studio.worker.wire import BUSY, FAILED, NOT_FOUND, Outbox, RequestError

MAX_SESSIONS = 4
MIN_SPEED, MAX_SPEED = 1 / 64, 8.0

Command = Callable[["Running"], None]  # must reply to its request, also for a session that `is_closed`


@dataclasses.dataclass
class Running:
    """Session with its speed and its waiting commands."""

    session: Session
    is_running: bool = False
    speed: float = 1.0
    is_closed: bool = False
    due: float = 0.0  # time.monotonic() of the next step
    commands: collections.deque[tuple[Future[Any] | None, Command]] = dataclasses.field(
        default_factory=collections.deque
    )

    @property
    def period(self) -> float:
        """Seconds from step to step."""
        return self.session.step_seconds / self.speed

    def run(self, is_running: bool) -> None:
        self.is_running = is_running and not self.session.is_at_end
        self.due = time.monotonic() + self.period

    def is_ready(self) -> bool:
        """True where the next command waits for no other thread."""
        return bool(self.commands) and (self.commands[0][0] is None or self.commands[0][0].done())


class SessionLoop:
    """The thread that runs all sessions of a worker."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._condition = threading.Condition()
        self._running: dict[int, Running] = {}
        self._num_reserved = 0
        self._last_number = 0
        self._thread = threading.Thread(target=self._loop, name="sessions", daemon=True)
        self._thread.start()

    @property
    def num_sessions(self) -> int:
        with self._condition:
            return len(self._running) + self._num_reserved

    @property
    def is_stepping(self) -> bool:
        with self._condition:
            return any(running.is_running for running in self._running.values())

    def reserve(self) -> int:
        """Reserves a number for a session; `add` or `cancel_reservation` follows. Raises RequestError."""
        with self._condition:
            if len(self._running) + self._num_reserved >= MAX_SESSIONS:
                raise RequestError(BUSY, f"{MAX_SESSIONS} sessions are open; close one")
            self._num_reserved += 1
            self._last_number = self._last_number % 0xFFFF + 1
            return self._last_number

    def cancel_reservation(self) -> None:
        with self._condition:
            self._num_reserved -= 1

    def add(self, session: Session) -> None:
        with self._condition:
            self._num_reserved -= 1
            self._running[session.number] = Running(session)

    def session(self, number: int) -> Session:
        """Open session of a number. Raises RequestError."""
        with self._condition:
            return self._of(number).session

    def _of(self, number: int) -> Running:
        if number not in self._running:
            raise RequestError(NOT_FOUND, f"there is no session {number} (any more)")
        return self._running[number]

    def command(self, number: int, command: Command, *, after: Future[Any] | None = None) -> None:
        """Queues a command for a session, to run once `after` is done. Raises RequestError for one not open."""
        with self._condition:
            self._of(number).commands.append((after, command))
            self._condition.notify()
        if after is not None:
            after.add_done_callback(lambda _: self._wake())

    def close(self, running: Running) -> None:
        """Ends a session; called by a command. Later commands of the session reply that there is none."""
        number = running.session.number
        running.is_running, running.is_closed = False, True
        with self._condition:
            self._running.pop(number, None)
        self._outbox.discard_frames(number)

    def show(self, running: Running) -> None:
        """Sends the shown state as a frame."""
        session = running.session
        self._outbox.send_frame(session.number, session.frame())

    def end_if_over(self, running: Running) -> None:
        session = running.session
        if not session.is_at_end:
            return
        running.is_running = False
        self._outbox.send(
            {
                "type": "play.end",
                "session": session.number,
                "step": session.shown,
                "outcome": session.outcome,
                "return": float(session.moments[session.shown].env_state.episode_return[0]),
            }
        )

    def _wake(self) -> None:
        with self._condition:
            self._condition.notify()

    def _loop(self) -> None:
        while True:
            for running in self._next():
                try:
                    self._advance(running)
                except Exception as error:
                    self._fail(running, error)

    def _next(self) -> list[Running]:
        """Sessions with a ready command or a due step. Waits for one."""
        with self._condition:
            while True:
                now = time.monotonic()
                ready = [
                    running
                    for running in self._running.values()
                    if running.is_ready() or (running.is_running and running.due <= now)
                ]
                if ready:
                    return ready
                dues = [running.due for running in self._running.values() if running.is_running]
                self._condition.wait(max(0.0, min(dues) - now) if dues else None)

    def _advance(self, running: Running) -> None:
        while running.is_ready():
            with self._condition:
                _, command = running.commands.popleft()
            command(running)
        if not running.is_running or running.due > time.monotonic():
            return
        running.session.step()
        self.show(running)
        self.end_if_over(running)
        # A late step stays late: no burst of steps after a pause of the machine.
        running.due = max(running.due + running.period, time.monotonic())

    def _fail(self, running: Running, error: Exception) -> None:
        """Ends a session after an error: a bug of ours, or a problem of its policy."""
        number, code, text = running.session.number, FAILED, str(error)
        if isinstance(error, RequestError):
            code = error.code
        else:
            traceback.print_exception(error)
            text = f"session {number} ended by a bug in the worker: {type(error).__name__}; its log has the traceback"
        self.close(running)
        self._outbox.send({"type": "error", "session": number, "code": code, "text": text})
