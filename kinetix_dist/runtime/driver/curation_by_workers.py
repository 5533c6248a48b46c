"""Workers score levels themselves, between two updates (`run.num_curators` 0): a `roles.Curator` without a process.

On a GPU two processes take turns, and scoring beside training costs more than the time it takes alone. A refresh is
adopted at the same update as that of a curator beside, so both give the same run bit for bit. It is worked out right
before that, from what was handed in when it was asked for: so a run that is resumed makes its first update without
waiting for one.

consumes      weights of a version
produces      what the curriculum adopts, in as many parts as there are workers that have a batch of candidates
waits for     the slowest worker
unblocked by  an answer, a loss (the run goes back to its checkpoint, and the refresh is asked for again), a time limit
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.roles import Refresh


class _Request(NamedTuple):
    """Arguments of `ColocatedTrainer.refresh`."""

    weights: Any
    policy_version: int
    probe: Any
    given: Any


class CurationByWorkers:
    """Of a run whose workers learn and play."""

    works_beside = False

    def __init__(self, trainer: ColocatedTrainer) -> None:
        self._trainer = trainer
        self._request: _Request | None = None

    def request(self, weights: Any, policy_version: int, probe: Any, given: Any) -> None:
        self._request = _Request(weights, policy_version, probe, given)

    def watch(self) -> None:
        pass

    def take(self, *, patience_s: float | None, meanwhile: Callable[[], None] = lambda: None) -> Refresh | None:
        """Works out what was asked for."""
        del patience_s, meanwhile
        assert self._request is not None, "a refresh is taken after it was asked for"
        refresh = self._trainer.refresh(*self._request)
        self._request = None
        return refresh

    def cancel(self) -> None:
        self._request = None

    def facts(self) -> list[dict[str, Any]]:
        return []

    def stop(self) -> None:
        pass
