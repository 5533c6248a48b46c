"""Progress for a person: one live line on a terminal, one line every few seconds in a log.

training  12,288 / 1,000,000 env steps  3,912 steps/s  solved 31 %  learnability 0.12  4:10 left
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Protocol

from rich.console import Console
from rich.live import Live
from rich.text import Text

from kinetix_dist.telemetry.names import check_metrics

LOG_EVERY_S = 10.0  # without a terminal, so that a log of an hour stays readable


class Progress(Protocol):
    """Shows the progress of a run to a person."""

    def set_phase(self, phase: str) -> None:
        """Shows the current phase, a word or two."""

    def set_seconds_left(self, seconds: float | None) -> None:
        """Sets the time until the end of the run; None if it is unknown."""

    def note(self, message: str) -> None:
        """Shows a line that stays."""

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        """Shows the metrics of an update."""

    def close(self) -> None:
        """Ends the display."""


class ConsoleSink:
    """Shows phase, env steps, steps/s, solve rate, learnability of the buffer and time left."""

    def __init__(self, *, total_env_steps: int | None, console: Console | None = None) -> None:
        """`total_env_steps` None: the run ends by time, and `set_progress` tells how far it is."""
        self._console = console or Console(stderr=True, highlight=False)
        self._total_env_steps = total_env_steps
        self._values: dict[str, float] = {}
        self._phase = "starting"
        self._seconds_left: float | None = None
        self._last_log_s = -math.inf
        self._live = None
        if self._console.is_terminal:
            self._live = Live(self._line(), console=self._console, refresh_per_second=4, transient=True)
            self._live.start()

    def set_phase(self, phase: str) -> None:
        """Shows the current phase, a word or two, at once."""
        if phase != self._phase:
            self._phase = phase
            self._show(at_once=phase != "training")

    def set_seconds_left(self, seconds: float | None) -> None:
        self._seconds_left = seconds

    def note(self, message: str) -> None:
        """A line that stays: an event such as a restart or a rejected checkpoint."""
        self._console.print(message, markup=False, soft_wrap=True)

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        self._values.update(check_metrics(metrics))
        self._values["progress/updates"] = update
        self._show(at_once=False)

    def close(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._console.print(self._line())

    def _show(self, *, at_once: bool) -> None:
        if self._live is not None:
            self._live.update(self._line())
        elif at_once or time.monotonic() - self._last_log_s >= LOG_EVERY_S:
            self._last_log_s = time.monotonic()
            self._console.print(self._line(), soft_wrap=True)

    def _line(self) -> Text:
        parts = [f"{self._phase:<12}"]
        if "progress/env_steps" in self._values:
            of_total = "" if self._total_env_steps is None else f" / {self._total_env_steps:,}"
            parts.append(f"{self._values['progress/env_steps']:,.0f}{of_total} env steps")
        for name, form in (
            ("progress/env_steps_per_second", "{:,.0f} steps/s"),
            ("train/solve_rate", "solved {:.0%}"),
            ("curriculum/learnability", "learnability {:.3f}"),
        ):
            if math.isfinite(value := self._values.get(name, math.nan)):
                parts.append(form.format(value))
        if self._seconds_left is not None:
            minutes, seconds = divmod(int(self._seconds_left), 60)
            parts.append(f"{minutes}:{seconds:02d} left")
        return Text("  ".join(parts))
