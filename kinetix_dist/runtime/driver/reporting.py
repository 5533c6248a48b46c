"""Where the progress of a run goes: the console, metrics.jsonl and TensorBoard events."""

from __future__ import annotations

from collections.abc import Mapping

from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from kinetix_dist.telemetry.sinks.tensorboard import TensorboardSink


class RunReporter:
    """A `roles.Reporter`. Files are opened with the first metrics, when it is known where the run goes on."""

    def __init__(self, run: RunDirectory, console: ConsoleSink) -> None:
        self._run = run
        self._console = console
        self._files: tuple[JsonlSink, TensorboardSink] | None = None
        self._last_update = 0

    def phase(self, name: str) -> None:
        self._console.set_phase(name)

    def note(self, message: str) -> None:
        self._console.note(message)

    def metrics(self, num_updates: int, metrics: Mapping[str, float], seconds_left: float | None) -> None:
        """Metrics of the update that led to `num_updates`; rows of later updates, of a killed session, are removed."""
        if self._files is None or num_updates <= self._last_update:
            self._close_files()
            env_steps = int(metrics["progress/env_steps"])
            path = self._run.metrics / "metrics.jsonl"
            rows = JsonlSink(path, resume_at=num_updates - 1)
            self._files = (rows, TensorboardSink(self._run.metrics, purge_after=env_steps))
            self._run.set_aside(path, rows.num_damaged)
        self._last_update = num_updates
        self._console.set_seconds_left(seconds_left)
        for sink in (*self._files, self._console):
            sink.write(num_updates, metrics)

    def close(self) -> None:
        self._close_files()
        self._console.close()

    def _close_files(self) -> None:
        for sink in self._files or ():
            sink.close()
        self._files = None
