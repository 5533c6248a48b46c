"""Updates in which no gradient step was finite: all are skipped, so that nothing is learned.

M in a row       back to the last checkpoint: a device or a disk may have put a wrong number somewhere
the same again   the run ends: all randomness is fixed, so it would come again for ever
all of a run     it does not end as if it had learned something
"""

from __future__ import annotations

import dataclasses

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
        """Whether a part of an update was skipped for the first time."""
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
