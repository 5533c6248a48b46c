"""Interleaved timing: everything runs once before anything runs again, so that a busy moment of a machine falls on all.

runs = [TimedRun("standard", lambda: microseconds(...)), ...]
time_interleaved(runs, repeats=5, report=print)
runs[0].cost                                        # the median
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Sequence

import jax

# What running out of memory, or a peer that dies, raises; anything else is a mistake in the program and shows as one.
FAILURES = (jax.errors.JaxRuntimeError, MemoryError, OSError)


@dataclasses.dataclass(eq=False)
class TimedRun:
    """Something to time. `run` does it once and returns its cost in us per simulated world-second; it may fail."""

    name: str
    run: Callable[[], float]
    costs: list[float] = dataclasses.field(default_factory=list)  # filled by time_interleaved
    failure: str | None = None  # one line; it is not run again

    @property
    def cost(self) -> float:
        """us per simulated world-second: the median of its runs."""
        return statistics.median(self.costs)


def time_interleaved(
    runs: Sequence[TimedRun],
    *,
    repeats: int,
    report: Callable[[str], None],
    after_round: Callable[[], None] = lambda: None,
) -> None:
    """`repeats` timed rounds after one that is not timed (it compiles). A run that fails is reported and left out of
    the rounds that follow; its `failure` says why. `after_round` is called once every run has one time more."""
    for number in range(repeats + 1):
        report(f"timing: {f'round {number} of {repeats}' if number else 'warming up'}, {len(runs)} batches")
        for one in runs:
            if one.failure is not None:
                continue
            try:
                cost = one.run()
            except FAILURES as error:
                one.failure = f"{one.name}: {one_line(error)}"
                report(f"failed: {one.failure}")
                continue
            if number > 0:
                one.costs.append(cost)
        if number > 0:
            after_round()


def one_line(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
