"""Timing that takes turns: every setting runs once before any runs again, so that a busy moment falls on all."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Sequence

import jax

# What running out of memory, or a peer that dies, raises; anything else is a mistake in the program and shows as one.
FAILURES = (jax.errors.JaxRuntimeError, MemoryError, OSError)


@dataclasses.dataclass(eq=False)
class Turn:
    """Something to time. `run` does it once and returns its cost in us per simulated world-second; it may fail."""

    name: str
    run: Callable[[], float]
    costs: list[float] = dataclasses.field(default_factory=list)  # filled by take_turns
    failure: str | None = None  # one line; no more turns after it

    @property
    def cost(self) -> float:
        """us per simulated world-second: the median of its runs."""
        return statistics.median(self.costs)


def take_turns(turns: Sequence[Turn], *, repeats: int, report: Callable[[str], None]) -> None:
    """`repeats` timed rounds after one that is not timed (it compiles). What fails is reported and left out of the
    rounds that follow; its `failure` says why."""
    for number in range(repeats + 1):
        report(f"timing: {f'round {number} of {repeats}' if number else 'warming up'}, {len(turns)} batches")
        for turn in turns:
            if turn.failure is not None:
                continue
            try:
                cost = turn.run()
            except FAILURES as error:
                turn.failure = f"{turn.name}: {one_line(error)}"
                report(f"failed: {turn.failure}")
                continue
            if number > 0:
                turn.costs.append(cost)


def one_line(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
