"""Workers score levels themselves, between two updates (`run.num_curators` 0): a `roles.Curator` without a process.

On a GPU two processes take turns, and scoring beside training costs more than the time it takes alone. A refresh is
adopted at the same update as that of a curator beside, so both give the same run bit for bit.

consumes      weights of a version
produces      what the curriculum adopts, in as many parts as there are workers that have a batch of candidates
waits for     the slowest worker
unblocked by  an answer, a loss (the run goes back to its checkpoint, and the refresh is asked for again), a time limit
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.roles import Refresh


class CurationByWorkers:
    """Of a run whose workers learn and play."""

    works_beside = False

    def __init__(self, trainer: ColocatedTrainer) -> None:
        self._trainer = trainer
        self._refresh: Refresh | None = None

    def request(self, weights: Any, policy_version: int, probe: Any, given: Any) -> None:
        """Returns when it is done."""
        with self._trainer.backend.sections.section("curate"):
            self._refresh = self._trainer.refresh(weights, policy_version, probe, given)

    def watch(self) -> None:
        pass

    def take(self, *, patience_s: float | None, meanwhile: Callable[[], None] = lambda: None) -> Refresh | None:
        del patience_s, meanwhile
        refresh, self._refresh = self._refresh, None
        return refresh

    def cancel(self) -> None:
        self._refresh = None

    def facts(self) -> list[dict[str, Any]]:
        return []

    def stop(self) -> None:
        pass
