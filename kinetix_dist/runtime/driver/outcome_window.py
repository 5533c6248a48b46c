"""Attempts of training by where levels come from, added up over some updates: a line of outcomes.jsonl a window.

A window ends after every `every` updates of the run, before a batch whose levels are drawn from another buffer, and at
the end of training. What is in it is part of checkpoints, so that a resumed run writes the same lines. A checkpoint of
an earlier version has counts of all episodes in its window: that ends there, as a line of its own format.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import select_arrays
from kinetix_dist.telemetry.curriculum_log import ALL_EPISODES_FORMAT, OUTCOMES_FORMAT

WINDOW = "outcomes"  # arrays of a checkpoint: what is in the window
Counts = Mapping[str, np.ndarray]


class OutcomeWindow:
    """The window of one run. Lines are plain JSON types, by the names of docs/run_data.md."""

    def __init__(self, sources: tuple[str, ...], every: int) -> None:
        """sources: of the curriculum, what the first counts are of; every: updates, above 0."""
        self._sources = sources
        self._every = every
        self.start({}, {}, num_updates=0)

    def start(self, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, num_updates: int) -> None:
        """As a checkpoint has it, taken after so many updates; empty where both are."""
        self._from_update: int = description.get("outcomes_from", num_updates)
        self._buffer: int | None = description.get("outcomes_buffer")
        self._counts = {name: array.astype(np.int64) for name, array in select_arrays(arrays, WINDOW).items()}

    def add(self, num_updates: int, attempts: Counts, buffer: int | None) -> list[dict[str, Any]]:
        """Takes the counts of the update that led to `num_updates`; lines of windows that are over.

        attempts: "solved" and "attempts", [sources + places]; buffer: whose levels the places hold, or None.
        """
        lines = []
        if self._counts and (buffer != self._buffer or self._counts.keys() != attempts.keys()):
            lines += self.end(num_updates - 1)
        self._buffer = buffer
        self._counts = {name: self._counts.get(name, 0) + counts.astype(np.int64) for name, counts in attempts.items()}
        if num_updates % self._every == 0:
            lines += self.end(num_updates)
        return lines

    def end(self, num_updates: int) -> list[dict[str, Any]]:
        """The line of what is there after so many updates, if there is any; the next window begins."""
        if not self._counts:
            return []
        line_format = ALL_EPISODES_FORMAT if "finished" in self._counts else OUTCOMES_FORMAT
        line = {"format": line_format, "update": num_updates, "from_update": self._from_update}
        if self._buffer is not None:
            line["buffer"] = self._buffer
        num_sources = len(self._sources)
        if len(self._counts["solved"]) > num_sources:
            line |= {name: counts[num_sources:].tolist() for name, counts in self._counts.items()}
        line["sources"] = {
            source: {name: int(counts[index]) for name, counts in self._counts.items()}
            for index, source in enumerate(self._sources)
        }
        self._from_update, self._counts = num_updates, {}
        return [line]

    def description(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"outcomes_from": self._from_update, "outcomes_buffer": self._buffer}

    def in_flight(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint."""
        return {f"{WINDOW}/{name}": counts for name, counts in self._counts.items()}
