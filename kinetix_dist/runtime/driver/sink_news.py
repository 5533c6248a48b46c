"""What sinks in threads of their own have to say, as events and notes in the thread of the run."""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any

from kinetix_dist.runtime.driver.run_directory import RunDirectory


class SinkNews:
    """`put` is for any thread, `tell` for that of the run."""

    def __init__(self, run: RunDirectory, note: Callable[[str], None]) -> None:
        self._run = run
        self._note = note
        self._news: queue.SimpleQueue[tuple[str, dict[str, Any]]] = queue.SimpleQueue()

    def put(self, kind: str, details: dict[str, Any]) -> None:
        """An event, and what it says."""
        self._news.put((kind, details))

    def tell(self, num_updates: int) -> None:
        """All that came since."""
        self._run.write_pending_events()
        while not self._news.empty():
            kind, details = self._news.get()
            self._run.event(kind, update=num_updates, **details)
            if kind == "sink_failing":
                self._note(f"{details['sink']}: {details['error']}; rows are dropped and counted, training goes on")
            elif kind == "sink_recovered":
                self._note(f"{details['sink']} takes rows again; {details['dropped']} were dropped")
