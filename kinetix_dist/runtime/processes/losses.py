"""Processes that were lost: what was lost in which section, how often, and how long it took to go on.

A recovery is measured from the loss to the first new result (an update, a batch, a buffer): starting, loading and
compiling are inside.
"""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Callable

from kinetix_dist.runtime.processes.failures import TooManyLossesError, WorkerLostError
from kinetix_dist.telemetry.names import ROLES

HOUR_S = 3600.0


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
    ) -> None:
        """limit: of losses within an hour."""
        self._limit = limit
        self._on_event = on_event
        self._on_note = on_note
        self.update = 0  # done so far
        self.restarts = dict.fromkeys(ROLES, 0)
        self.recovery_seconds: dict[str, float] = {}  # of the last recovery, by role
        self._times: deque[float] = deque()

    @property
    def num_restarts(self) -> int:
        return sum(self.restarts.values())

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
        self._on_event("process_lost", **details, error=str(error), restart=count)
        where = f" (section {loss.section!r})" if loss.section else ""
        if count > self._limit:
            raise TooManyLossesError(
                f"{error}{where}; that is loss {count} within an hour, and run.max_restarts is {self._limit}"
            ) from error
        self.restarts[role] += 1
        self._on_note(f"{error}{where}; restart {count} of {self._limit} within an hour")
        return loss

    def recovered(self, loss: Loss, *, update: int) -> None:
        """The first new result after a loss is there. update: at which that is."""
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
