"""Totals over all sessions of a run, and checks of its updates: seconds by role, physics counters, skipped updates.

Each checkpoint holds the sums until then. A report holds more: the evaluation and the recordings after the last
checkpoint. A run that goes on begins with the sums of the report that belongs to its checkpoint, or of the checkpoint.

An update is skipped where none of its gradient steps was finite, so that nothing is learned:

    M in a row       back to the last checkpoint: a device or a disk may have put a wrong number somewhere
    the same again   the run ends: all randomness is fixed, so it would come again for ever
    all of a run     it does not end as if it had learned something
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
        """The first lap begins now; what was added before stays in the totals."""
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
    """Says whether a run has come to its configured end: at once where it has imitation alone."""
    if not run.total_env_steps and not run.max_seconds:
        return True
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


DESCRIPTION = "sessions"  # of checkpoint.json


@dataclasses.dataclass(frozen=True)
class SessionTotals:
    """Sums over the sessions before this one."""

    wall_seconds: float = 0.0
    seconds_by_role: Mapping[str, float] = dataclasses.field(default_factory=dict)
    physics: Mapping[str, int] = dataclasses.field(default_factory=dict)  # as PhysicsWatch.totals


def totals_before(report_path: Path, description: Mapping[str, Any]) -> SessionTotals:
    """Sums at a checkpoint that a run goes on from. description: of the checkpoint; those of earlier versions have
    training seconds only."""
    report = read_report(report_path)
    if report is not None and report["policy_updates"] == description["num_updates"]:
        physics = {name: count for name, count in report["physics"].items() if name != "settings"}
        return SessionTotals(report["wall_seconds"], report["seconds_by_role"], physics)
    stored = description.get(DESCRIPTION, {"wall_seconds": description["training_seconds"]})
    return SessionTotals(**stored)


def read_report(path: Path) -> dict[str, Any] | None:
    """The report of a run; None where it has none, or one that is no report."""
    try:
        report = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    needed = {"policy_updates": int, "env_steps": int, "training_seconds": float, "wall_seconds": float}
    needed |= {"seconds_by_role": dict, "physics": dict, "config_hash": str}
    is_whole = isinstance(report, dict) and all(isinstance(report.get(name), kind) for name, kind in needed.items())
    return report if is_whole else None


PREFIX = "physics/"
COUNTED_AS_NUMBER = "physics/unstable_worlds"  # the same as physics/unstable

# What should be zero: (what happened, what to do). Speed limits may act.
WARNINGS = {
    "unstable": (
        "worlds were not finite and were reset",
        "raise env.physics.substeps or take --env.preset fine; metric physics/unstable counts them",
    ),
    "contact_overflow": (
        "contacts found no slot in the engine and did nothing",
        "levels are more crowded than size env.size holds; take a larger one",
    ),
    "missing_effects": (
        "environment steps lacked an effect that their level calls for",
        "report it: the engine was made for fewer effects than the run needs",
    ),
    "invalid_actions": (
        "numbers of actions were out of range and acted as off",
        "the policy and env.action_space do not belong together",
    ),
    "invalid_rewards": (
        "rewards were not finite and counted as 0",
        "correct the reward that env.reward names, or lower env.dense_reward_scale",
    ),
    "invalid_controls": (
        "controls were out of range or nan",
        "look at the levels with `kinetix-dist levels validate`",
    ),
    "invalid_scene": (
        "joints, thrusters or polygons of levels made no sense, counted in every step",
        "look at the levels with `kinetix-dist levels validate`",
    ),
}


class PhysicsWatch:
    """Adds up the metrics of updates."""

    def __init__(self) -> None:
        self._physics_steps = 0
        self._counts: dict[str, int] = {}
        self._warned: set[str] = set()

    @property
    def totals(self) -> dict[str, int]:
        """Totals for the report: physics steps of all worlds, and how often each counter was raised in them."""
        return {"physics_steps": self._physics_steps, **self._counts}

    def add_earlier(self, totals: Mapping[str, int]) -> None:
        """`totals` of earlier sessions."""
        for name, count in totals.items():
            if name == "physics_steps":
                self._physics_steps += count
            else:
                self._counts[name] = self._counts.get(name, 0) + count

    def add(self, metrics: Mapping[str, float], physics_steps: int) -> Iterator[tuple[str, int, str]]:
        """Takes the metrics of an update of so many physics steps; (kind, count, warning) the first time of a kind."""
        self._physics_steps += physics_steps
        for name, rate in metrics.items():
            if not name.startswith(PREFIX) or name == COUNTED_AS_NUMBER:
                continue
            kind = name.removeprefix(PREFIX)
            count = round(rate * physics_steps / 1e6)
            self._counts[kind] = self._counts.get(kind, 0) + count
            if count and kind in WARNINGS and kind not in self._warned:
                self._warned.add(kind)
                what, remedy = WARNINGS[kind]
                yield kind, count, f"physics: {count:,} {what} in {physics_steps:,} physics steps; {remedy}"


REMEDY = (
    "no gradient was finite: lower ppo.learning_rate or ppo.max_grad_norm, and look at physics/* and learner/* in "
    "metrics.jsonl"
)


class NotFiniteError(Exception):
    """A run that cannot learn: which updates were skipped, and what to do."""


@dataclasses.dataclass
class SkippedUpdates:
    """Counts over a session."""

    limit: int  # M
    num_seen: int = 0
    num_skipped: int = 0
    in_a_row: int = 0
    had_partly_skipped: bool = False
    _gone_back_for: int | None = None  # the first update of the last row that was gone back for

    def add(self, skipped_steps: float, *, num_steps: int) -> bool:
        """Takes `learner/skipped_steps` of an update of so many gradient steps; whether all of it was skipped."""
        self.num_seen += 1
        is_skipped = skipped_steps >= num_steps
        self.num_skipped += is_skipped
        self.in_a_row = self.in_a_row + 1 if is_skipped else 0
        return is_skipped

    def is_new_kind(self, skipped_steps: float, *, num_steps: int) -> bool:
        """Says whether a part of an update was skipped for the first time."""
        is_new = 0 < skipped_steps < num_steps and not self.had_partly_skipped
        self.had_partly_skipped |= is_new
        return is_new

    def must_go_back(self, num_updates: int) -> bool:
        """After update `num_updates`. Raises NotFiniteError where the run went back for these updates already."""
        if self.in_a_row < self.limit:
            return False
        first = num_updates - self.in_a_row + 1
        if self._gone_back_for is not None and first <= self._gone_back_for:
            raise NotFiniteError(
                f"updates {first} to {num_updates} were skipped, also after going back to the last checkpoint; {REMEDY}"
            )
        self._gone_back_for, self.in_a_row = first, 0
        return True

    def check_end(self) -> None:
        """Raises NotFiniteError where every update of the session was skipped."""
        if self.num_seen and self.num_skipped == self.num_seen:
            raise NotFiniteError(f"all {self.num_seen} updates were skipped; {REMEDY}")
