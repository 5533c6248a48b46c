"""Rollout actors that are slower than the others, update after update (split placement).

One slow batch says little: a new actor compiles, a machine is busy for a moment. An actor is a straggler after
UPDATES_IN_A_ROW batches, each of which took it more than TIMES_THE_OTHERS the median of the others. That is told
once, and again only after as many batches in a row that were not slow.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

TIMES_THE_OTHERS = 2.0
UPDATES_IN_A_ROW = 5


class Stragglers:
    """Among the rollout actors of a run."""

    def __init__(self, on_event: Callable[..., None]) -> None:
        """`on_event(kind, **details)`"""
        self._on_event = on_event
        self._found: dict[int, _Found] = {}  # by number of the actor

    def add(self, update: int, stamps: Sequence[Mapping[str, Any]]) -> None:
        """Takes what the actors say of a batch, in their order: "seconds" and "num_env_steps"."""
        for actor, stamp in enumerate(stamps):
            others = [*stamps[:actor], *stamps[actor + 1 :]]
            if not others:
                return
            seconds = statistics.median(other["seconds"] for other in others)
            found = self._found.setdefault(actor, _Found())
            is_slow = stamp["seconds"] > TIMES_THE_OTHERS * seconds * _more_work(stamp, others)
            if found.is_news(is_slow=is_slow):
                self._on_event(
                    "straggler",
                    process=f"rollout {actor}",
                    update=update,
                    in_a_row=UPDATES_IN_A_ROW,
                    seconds=round(stamp["seconds"], 3),
                    seconds_of_others=round(seconds, 3),
                )

    def forget(self, actor: int) -> None:
        """Another process, perhaps on another machine, has taken its place."""
        self._found.pop(actor, None)


@dataclasses.dataclass
class _Found:
    """Of one actor."""

    is_straggler: bool = False
    in_a_row: int = 0  # batches that say the contrary

    def is_news(self, *, is_slow: bool) -> bool:
        """Whether it has become one with this batch."""
        self.in_a_row = self.in_a_row + 1 if is_slow != self.is_straggler else 0
        if self.in_a_row < UPDATES_IN_A_ROW:
            return False
        self.is_straggler, self.in_a_row = is_slow, 0
        return is_slow


def _more_work(stamp: Mapping[str, Any], others: Sequence[Mapping[str, Any]]) -> float:
    """Times the steps of the others that an actor plays, where it plays more: parts need not be of one size.

    Never below 1: a part of half the size takes more than half the time, on GPUs nearly as much.
    """
    return max(stamp["num_env_steps"] / statistics.median(other["num_env_steps"] for other in others), 1.0)
