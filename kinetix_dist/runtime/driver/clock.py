"""Where the time of a run goes, by role."""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager

from kinetix_dist.config import RunConfig

ROLES = ("rollout", "learn", "curate", "evaluate", "record", "checkpoint")


class RoleClock:
    """Adds up seconds by role between laps; what no role claims is idle."""

    def __init__(self) -> None:
        self.totals = dict.fromkeys((*ROLES, "idle"), 0.0)  # s, over all laps of all sessions
        self._lap = dict.fromkeys(ROLES, 0.0)
        self._began: float | None = None
        self._lap_began = time.monotonic()

    def add_earlier(self, seconds: Mapping[str, float]) -> None:
        """Totals of earlier sessions, as they were then; before `start`."""
        for name, value in seconds.items():
            self.totals[name] = self.totals.get(name, 0.0) + value

    def start(self) -> None:
        """The first lap begins now; what was added before is kept in the totals."""
        self._fold()
        self._began = self._lap_began = time.monotonic()

    @property
    def elapsed(self) -> float:
        """s since `start`, 0 before."""
        return 0.0 if self._began is None else time.monotonic() - self._began

    @contextmanager
    def role(self, name: str) -> Generator[None, None, None]:
        began = time.monotonic()
        try:
            yield
        finally:
            self._lap[name] += time.monotonic() - began

    def add(self, seconds: Mapping[str, float]) -> None:
        """Seconds measured elsewhere, by a worker say."""
        for name, value in seconds.items():
            self._lap[name] += value

    def lap(self) -> tuple[float, dict[str, float]]:
        """Ends a lap: (its length in s, the share of each role and of "idle")."""
        now = time.monotonic()
        span = max(now - self._lap_began, 1e-9)
        self._lap_began = now
        seconds = dict(self._lap)
        # Roles that work at the same time (split placement) can claim more than there was: they are scaled to fit.
        scale = min(1.0, span / max(sum(seconds.values()), 1e-9))
        shares = {name: value * scale / span for name, value in seconds.items()}
        shares["idle"] = max(0.0, 1.0 - sum(shares.values()))
        self._fold()
        self.totals["idle"] += shares["idle"] * span
        return span, shares

    def _fold(self) -> None:
        for name, value in self._lap.items():
            self.totals[name] += value
        self._lap = dict.fromkeys(ROLES, 0.0)


def is_over(run: RunConfig, *, env_steps: int, training_seconds: float) -> bool:
    """Whether a run has come to its configured end."""
    if run.total_env_steps and env_steps >= run.total_env_steps:
        return True
    return bool(run.max_seconds) and training_seconds >= run.max_seconds


def seconds_left(run: RunConfig, *, env_steps: int, training_seconds: float) -> float:
    """Until the end of training, at the speed so far. env_steps, training_seconds: since the start of the run."""
    ends = []
    if run.max_seconds:
        ends.append(run.max_seconds - training_seconds)
    if run.total_env_steps:
        steps_per_second = env_steps / max(training_seconds, 1e-9)
        ends.append((run.total_env_steps - env_steps) / max(steps_per_second, 1e-9))
    return max(min(ends), 0.0)
