"""Processes that were lost: what was lost in which section, how often, and how long it took to go on.

A recovery is measured from the loss to the first new result (an update, a batch, a buffer): starting, loading and
compiling are inside.
"""

from __future__ import annotations

import dataclasses
import os
import socket
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kinetix_dist.runtime.processes.failures import TooManyLossesError, WorkerLostError
from kinetix_dist.telemetry.names import ROLES

HOUR_S = 3600.0
MAX_LOG_BYTES = 65536  # of the end of a log that is kept


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loss:
    """One process that was lost."""

    process: str  # "worker 1"
    role: str
    section: str
    update: int  # updates done then
    since: float  # time.monotonic()


class Losses:
    """Of one run."""

    def __init__(
        self,
        *,
        limit: int = 0,
        on_event: Callable[..., None] = lambda kind, **details: None,
        on_note: Callable[[str], None] = lambda message: None,
        on_log: Callable[[str, str], Path | None] = lambda name, text: None,
    ) -> None:
        """limit: of losses within an hour. on_log(name, text): keeps what a lost process wrote last; where it is."""
        self._limit = limit
        self._on_log = on_log
        self._logs: dict[str, Path] = {}  # by process: the files of this host that they write their errors to
        self._on_event = on_event
        self._on_note = on_note
        self.update = 0  # done so far
        self.restarts = dict.fromkeys(ROLES, 0)
        self.recovery_seconds: dict[str, float] = {}  # of the last recovery, by role
        self._times: deque[float] = deque()

    @property
    def num_restarts(self) -> int:
        return sum(self.restarts.values())

    def started(self, process: str, where: dict[str, Any]) -> None:
        """where: what it said of itself (`facts.whereabouts`)."""
        self._logs.pop(process, None)
        if where.get("log") is not None and where["host"] == socket.gethostname():
            self._logs[process] = Path(where["log"])

    def lost(self, error: WorkerLostError) -> Loss:
        """Tells of a loss and counts it. Raises TooManyLossesError where that was one too many within an hour."""
        now = time.monotonic()
        role = error.process.split()[0] if error.process else ""
        role = role if role in ROLES else "worker"  # not told by whom: it is the group then
        since = error.since if error.since is not None else now
        loss = Loss(process=error.process, role=role, section=error.section, update=self.update, since=since)
        self._times.append(now)
        while self._times[0] < now - HOUR_S:
            self._times.popleft()
        count = len(self._times)
        details = {"process": loss.process, "role": role, "section": loss.section, "update": loss.update}
        kept = self._keep_logs(loss)
        log = {"log": str(kept)} if kept is not None else {}
        self._on_event("process_lost", **details, error=str(error), restart=count, **log)
        where = f" (section {loss.section!r})" if loss.section else ""
        where += f"; what it wrote last is in {kept}" if kept is not None else ""
        if count > self._limit:
            raise TooManyLossesError(
                f"{error}{where}; that is loss {count} within an hour, and run.max_restarts is {self._limit}"
            ) from error
        self.restarts[role] += 1
        self._on_note(f"{error}{where}; restart {count} of {self._limit} within an hour")
        return loss

    def _keep_logs(self, loss: Loss) -> Path | None:
        """Of the lost process and the others of its role: one that dies takes its group along. Where that of the lost
        one is, if it wrote anything."""
        found = None
        for process, log in self._logs.items():
            if process.split()[0] == loss.role and (text := _end_of(log)):
                kept = self._on_log(process.replace(" ", "_"), text)
                found = kept if process == loss.process else found
        return found

    def recovered(self, loss: Loss, *, update: int) -> None:
        """The first new result after a loss is there: after each loss, where there were several. update: at which."""
        seconds = time.monotonic() - loss.since
        self.recovery_seconds[loss.role] = seconds
        details = {"process": loss.process, "role": loss.role, "section": loss.section}
        self._on_event("recovered", **details, from_update=loss.update, to_update=update, seconds=round(seconds, 3))

    def metrics(self) -> dict[str, float]:
        """`runtime/restarts` and `runtime/recovery_seconds`, in all and by role where there were any."""
        found: dict[str, float] = {"runtime/restarts": float(self.num_restarts)}
        found |= {f"runtime/restarts_{role}": float(count) for role, count in self.restarts.items() if count}
        if self.recovery_seconds:
            found["runtime/recovery_seconds"] = max(self.recovery_seconds.values())
        return found | {f"runtime/recovery_seconds_{role}": value for role, value in self.recovery_seconds.items()}


def _end_of(log: Path) -> str:
    """The last lines of a file; empty where it cannot be read."""
    try:
        with log.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - MAX_LOG_BYTES))
            return file.read().decode(errors="replace").strip()
    except OSError:
        return ""
