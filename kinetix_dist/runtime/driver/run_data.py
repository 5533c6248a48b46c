"""Files that training writes for dashboards, see docs/run_data.md: written by threads, and read by no process here.

    controller --rows--> [queue, bounded] --> a thread a file --> curriculum/*.npz, outcomes, evaluations, processes

No call waits for a disk. A row that a disk does not take is dropped and counted (`telemetry/dropped_writes`), with an
event.

`OutcomeWindow` adds up attempts by where their levels come from: a line of outcomes.jsonl a window. A window ends after
every `every` updates of the run, or with the next reset of the worlds after that, before a batch whose levels are drawn
from another buffer, and at the end of training. Its counts are part of checkpoints, so that a resumed run writes the
same lines. A checkpoint of an earlier version has counts of all episodes in its window: that ends there, as a line of
its own format.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import select_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.runtime.cores.rollout_sums import FRESH_PAIRS
from kinetix_dist.runtime.cores.run_names import CURRICULUM
from kinetix_dist.runtime.driver.reporting import DROPPED_WRITES
from kinetix_dist.runtime.driver.roles import Refresh, Reporter
from kinetix_dist.runtime.driver.run_directory import EVALUATIONS, PROCESSES, RunDirectory
from kinetix_dist.runtime.driver.run_files import LineFile, SinkEvents, SnapshotSink, UnfinishedSnapshot
from kinetix_dist.telemetry.curriculum_log import (
    BUFFER,
    OUTCOMES,
    OUTCOMES_FORMAT,
    REFRESH,
    is_outcomes,
)
from kinetix_dist.telemetry.json_lines import Row, utc_text
from kinetix_dist.telemetry.sinks import Evaluation
from kinetix_dist.telemetry.sinks.background import BackgroundSink, close_sinks
from kinetix_dist.telemetry.sinks.jsonl import LinesSink

FORMAT = 1  # of evaluations.jsonl and processes.jsonl
MAX_QUEUED_SNAPSHOTS = 8  # each keeps a refresh in memory, 2 MB a thousand levels of size L
PROCESSES_EVERY_S = 30.0

# By name of a file of lines: whether an object is a line of it, and whether that is not later than so many updates.
_FILES: dict[str, tuple[Callable[[Row], bool], Callable[[Row, int], bool]]] = {
    OUTCOMES: (is_outcomes, lambda row, num_updates: row["update"] <= num_updates),
    EVALUATIONS: (
        lambda row: row.get("format") == FORMAT and isinstance(row.get("reported_at"), int),
        lambda row, num_updates: row["reported_at"] <= num_updates,
    ),
    PROCESSES: (lambda row: isinstance(row.get("processes"), list), lambda row, num_updates: True),
}


class RunData:
    """Files of one run for dashboards. All methods are for the thread that drives it."""

    def __init__(self, config: TrainConfig, run: RunDirectory, reporter: Reporter) -> None:
        self._config = config
        self.run = run
        self.reporter = reporter
        log = config.curriculum_log
        self._has_snapshots = log.max_snapshots > 0
        self._window = None
        if log.outcomes_every:
            self._window = OutcomeWindow(log.outcomes_every, reset_every=config.rollout.reset_every)
        self._sink_events = SinkEvents(run, reporter.note)
        self._sinks: dict[Path, BackgroundSink[Any]] = {}
        self._num_dropped = 0  # by sinks that are closed
        # Updates done when this session, or the part of it since the last loss, began; -1: with nothing, evaluations
        # before training included.
        self._resume_at = -1
        self._is_curated = False  # a refresh that the next update uses was adopted before that checkpoint
        self._has_evaluated = False
        self._processes_at = 0.0  # s of time.monotonic(), of the last line
        self._pids: set[tuple[str, int]] = set()  # in the last line

    def start(self, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, num_updates: int) -> None:
        """Starts as a checkpoint says, taken after so many updates; afresh where both are empty. Later rows are
        removed."""
        self._close_sinks()
        self._resume_at = num_updates if num_updates or self._has_evaluated else -1
        self._is_curated = description.get("curated_for") == num_updates
        for path in (self.run.curriculum, self.run.outcomes, self.run.evaluation_rows, self.run.processes):
            if os.path.exists(path):  # an unreadable one fails, and is reported, with the first row
                self._sink(path, opens_at_once=True)
        if self._window is not None:
            sources = self._curriculum(max(num_updates - 1, 0)).sources
            self._window.start(description, arrays, num_updates=num_updates, sources=sources)

    def description(self) -> dict[str, Any]:
        """Description for a checkpoint."""
        return {} if self._window is None else self._window.description()

    def in_flight(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint."""
        return {} if self._window is None else self._window.in_flight()

    def adopted(self, refresh: Refresh, *, num_updates: int, first_batch: int) -> None:
        """A refresh is used from `first_batch` on. Its parts are fetched by the thread that writes them."""
        if not self._has_snapshots:
            return

        def arrays() -> dict[str, np.ndarray] | None:
            parts = [part.fetch_in_thread() for part in refresh.parts]
            log = self._curriculum(first_batch).refresh_log(self._phase(first_batch).curriculum, parts)
            if log is None:
                return None
            known = {"first_batch": np.array(first_batch, np.int32), "scoring_seconds": np.array(refresh.seconds)}
            return log | known | {f"probe/{name}": array for name, array in refresh.probe.items()}

        self._write_snapshot(REFRESH, num_updates, self._phase(first_batch), arrays)

    def saved(self, num_updates: int, arrays: Mapping[str, np.ndarray]) -> None:
        """A checkpoint of these arrays is taken after so many updates."""
        if not self._has_snapshots:
            return
        state = select_arrays(arrays, CURRICULUM)
        if state:  # else the next update begins another
            kind = self._curriculum(num_updates)

            def buffer() -> dict[str, np.ndarray] | None:
                log = kind.buffer_log(state)  # a state counts updates since it began
                return None if log is None else log | {"policy_version": np.array(num_updates, np.int32)}

            self._write_snapshot(BUFFER, num_updates, self._phase(num_updates), buffer)

    def played(
        self, num_updates: int, attempts: Mapping[str, np.ndarray], *, num_attempts: float, buffer: int | None
    ) -> None:
        """Attempts of the update that led to `num_updates`, see `Trainer.run_update`; num_attempts: in all, 0 where
        worlds go on; buffer: see `OutcomeWindow`. Raises ValueError where the curriculum left some out."""
        if self._window is None or not num_attempts:
            return
        if (counted := int(attempts["attempts"].sum())) != num_attempts:
            name = self._phase(num_updates - 1).curriculum.name
            raise ValueError(
                f"curriculum {name!r}: of {num_attempts:.0f} worlds {counted} have a source; "
                "Proposal.source must be 0 or more, and less than the number of its sources and slots"
            )
        sources = self._curriculum(num_updates - 1).sources
        self._write_outcomes(self._window.add(num_updates, attempts, buffer, sources))

    def trained(self, num_updates: int) -> None:
        """After the last update."""
        if self._window is not None:
            self._write_outcomes(self._window.end(num_updates))

    def evaluated(self, phase: str, update: int, rates: Mapping[str, Mapping[str, Any]], *, reported_at: int) -> None:
        """An evaluation of all sets is there; rates: as `Evaluator.evaluate` gives them."""
        row = {
            "format": FORMAT,
            "phase": phase,
            "update": update,
            "env_steps": self._config.schedule.env_steps(update),
            "reported_at": reported_at,
            "sets": {name: rate["levels"] for name, rate in rates.items()},
        }
        self._has_evaluated = True
        self._sink(self.run.evaluation_rows).write(reported_at, row)
        summary = {name: {k: v for k, v in rate.items() if k != "levels"} for name, rate in rates.items()}
        self.reporter.evaluated(
            Evaluation(phase=phase, update=update, env_steps=row["env_steps"], reported_at=reported_at, rates=summary)
        )

    def processes(self, num_updates: int, processes: Sequence[Mapping[str, Any]]) -> None:
        """Writes what they are at, if the last line is old enough, or some came or went since."""
        now = time.monotonic()
        pids = {(process["host"], process["pid"]) for process in processes}
        if pids == self._pids and now - self._processes_at < PROCESSES_EVERY_S:
            return
        self._processes_at, self._pids = now, pids
        row = {"format": FORMAT, "time": utc_text(), "update": num_updates, "processes": list(processes)}
        self._sink(self.run.processes).write(num_updates, row)

    def metrics(self, num_updates: int) -> dict[str, float]:
        """Metrics of dropped writes. Also reports the events of the threads."""
        self._sink_events.report(num_updates)
        dropped = self._num_dropped + sum(sink.num_dropped for sink in self._sinks.values())
        return {DROPPED_WRITES: float(dropped)}

    def close(self, num_updates: int) -> None:
        """Writes what is queued, as `BackgroundSink.close` does."""
        self._close_sinks()
        self._sink_events.report(num_updates)

    def _write_outcomes(self, lines: Sequence[Row]) -> None:
        for line in lines:
            self._sink(self.run.outcomes).write(line["update"], line)

    def _phase(self, batch: int) -> TrainConfig:
        return self._config.schedule.at(batch).config

    def _curriculum(self, batch: int) -> type[Curriculum]:
        return self._phase(batch).curriculum_class

    def _write_snapshot(
        self, kind: str, num_updates: int, phase: TrainConfig, arrays: Callable[[], dict[str, np.ndarray] | None]
    ) -> None:
        known = {"curriculum": np.str_(phase.curriculum.name), "size": np.str_(phase.env.size)}
        self._sink(self.run.curriculum).write(num_updates, UnfinishedSnapshot(kind, num_updates, known, arrays))

    def _sink(self, path: Path, *, opens_at_once: bool = False) -> BackgroundSink[Any]:
        """Sink of a file, or of the directory of snapshots."""
        if path not in self._sinks:
            bound = {"max_queued": MAX_QUEUED_SNAPSHOTS} if path == self.run.curriculum else {}
            self._sinks[path] = BackgroundSink(
                str(path.relative_to(self.run.path)),
                self._snapshots() if path == self.run.curriculum else self._lines(path),
                self._sink_events.put,
                patience_s=0.0,
                opens_at_once=opens_at_once,
                **bound,
            )
        return self._sinks[path]

    def _lines(self, path: Path) -> Callable[[], LinesSink]:
        is_row, is_earlier = _FILES[path.name]
        resume_at = self._resume_at

        def open_sink(is_first: bool) -> LinesSink:
            keep = (lambda row: is_earlier(row, resume_at)) if is_first else None
            return LinesSink(path, is_row=is_row, keep=keep)

        return LineFile(self.run.path, open_sink, self._sink_events.put, path).open

    def _snapshots(self) -> Callable[[], SnapshotSink]:
        sink = SnapshotSink(
            self.run.curriculum,
            max_snapshots=self._config.curriculum_log.max_snapshots,
            resume_at=self._resume_at,
            is_curated=self._is_curated,
            on_event=self._sink_events.put,
        )
        return sink.open

    def _close_sinks(self) -> None:
        close_sinks(list(self._sinks.values()))
        self._num_dropped += sum(sink.num_dropped for sink in self._sinks.values())
        self._sinks = {}


WINDOW = "outcomes"  # arrays of a checkpoint: what is in the window
Counts = Mapping[str, np.ndarray]


class OutcomeWindow:
    """The window of one run. Lines are plain JSON types, by the names of docs/run_data.md."""

    def __init__(self, every: int, *, reset_every: int = 1) -> None:
        """every: updates, above 0; reset_every: updates in which an attempt is played."""
        self._every = every
        self._reset_every = reset_every
        self.start({}, {}, num_updates=0, sources=())

    def start(
        self,
        description: Mapping[str, Any],
        arrays: Mapping[str, np.ndarray],
        *,
        num_updates: int,
        sources: tuple[str, ...],
    ) -> None:
        """Starts as a checkpoint says, taken after so many updates; empty where both are. sources: of the curriculum of
        the last of them."""
        self._sources = sources
        counts = select_arrays(arrays, WINDOW)
        is_open = "attempts" in counts
        self._from_update: int = description.get("outcomes_from", num_updates) if is_open else num_updates
        self._buffer: int | None = description.get("outcomes_buffer")
        self._counts = {name: array.astype(np.int64) for name, array in counts.items()} if is_open else {}

    def add(
        self, num_updates: int, attempts: Counts, buffer: int | None, sources: tuple[str, ...]
    ) -> list[dict[str, Any]]:
        """Takes the counts of the updates that led to `num_updates`; lines of windows that are over.

        attempts: "solved" and "attempts", [sources + slots], and FRESH_PAIRS where there are pairs; buffer: whose
        levels the slots hold, or None. sources: of the curriculum, what the first counts are of.
        """
        lines = []
        since = num_updates - self._reset_every
        if self._counts and (buffer, sources, _shapes(attempts)) != (
            self._buffer,
            self._sources,
            _shapes(self._counts),
        ):
            lines += self.end(since)
        self._buffer, self._sources = buffer, sources
        self._counts = {name: self._counts.get(name, 0) + counts.astype(np.int64) for name, counts in attempts.items()}
        if num_updates // self._every > since // self._every:
            lines += self.end(num_updates)
        return lines

    def end(self, num_updates: int) -> list[dict[str, Any]]:
        """The line of what is there after so many updates, if there is any; the next window begins."""
        if not self._counts:
            return []
        line: dict[str, Any] = {"format": OUTCOMES_FORMAT, "update": num_updates, "from_update": self._from_update}
        if self._buffer is not None:
            line["buffer"] = self._buffer
        num_sources = len(self._sources)
        by_source = {name: counts for name, counts in self._counts.items() if name != FRESH_PAIRS}
        if len(by_source["solved"]) > num_sources:
            line |= {name: counts[num_sources:].tolist() for name, counts in by_source.items()}
        line["sources"] = {
            source: {name: int(counts[index]) for name, counts in by_source.items()}
            for index, source in enumerate(self._sources)
        }
        if FRESH_PAIRS in self._counts:
            none, one, both = self._counts[FRESH_PAIRS].tolist()
            line[FRESH_PAIRS] = {"both": both, "one": one, "none": none}
        self._from_update, self._counts = num_updates, {}
        return [line]

    def description(self) -> dict[str, Any]:
        """Description for a checkpoint."""
        return {"outcomes_from": self._from_update, "outcomes_buffer": self._buffer}

    def in_flight(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint."""
        return {f"{WINDOW}/{name}": counts for name, counts in self._counts.items()}


def _shapes(counts: Counts) -> dict[str, tuple[int, ...]]:
    return {name: np.shape(array) for name, array in counts.items()}
