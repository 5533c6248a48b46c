"""Readings of the processes of a run, asked for after every update and never waited for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import ray

from kinetix_dist.runtime.processes.measures import Meter, Reading, description, summary


class Readings:
    """Of all actors of a backend, and of the driver itself. What is told is as old as one update."""

    def __init__(self) -> None:
        self._driver = Meter("driver", "driver")
        self._asked: dict[Any, Any] = {}  # actor -> reference to its next reading, or None
        self._asked_at: dict[Any, float] = {}  # actor -> s of time.monotonic() here
        # Actor -> the one before, the last one, when that was asked for.
        self._last: dict[Any, tuple[Reading | None, Reading, float]] = {}

    def add(self, actor: Any) -> None:
        self._asked[actor] = None

    def forget(self, actors: Sequence[Any]) -> None:
        for actor in actors:
            for known in (self._asked, self._asked_at, self._last):
                known.pop(actor, None)

    def metrics(self) -> dict[str, float]:
        """From what has been answered so far; asks again whoever has answered."""
        for actor, reference in self._asked.items():
            if reference is not None and not ray.wait([reference], timeout=0)[0]:
                continue
            if reference is not None:
                self._take(actor, reference)
            self._asked[actor], self._asked_at[actor] = actor.read.remote(), time.monotonic()
        driver = self._driver.read(has_device=False)
        found = summary([*((before, last) for before, last, _ in self._last.values()), (None, driver)])
        del found["runtime/moved_mib_driver"]  # it passes references on
        return found

    def processes(self) -> list[dict[str, Any]]:
        """What was answered last of each, and the driver now, as `measures.description` says it."""
        now = time.monotonic()
        found = [
            description(before, last, age_seconds=now - asked_at) for before, last, asked_at in self._last.values()
        ]
        return [*found, description(None, self._driver.read(has_device=False), age_seconds=0.0)]

    def _take(self, actor: Any, reference: Any) -> None:
        try:
            reading = ray.get(reference)
        except ray.exceptions.RayError:  # it is lost: whoever waits for its work tells of that
            self._last.pop(actor, None)
            return
        before = self._last.get(actor)
        self._last[actor] = (before[1] if before else None, reading, self._asked_at[actor])
