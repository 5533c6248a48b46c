"""When refreshes of the curriculum are asked for and adopted.

A refresh asked for at update k is adopted at update k + adopt_after, whatever the timing: training waits for a curator
at work. It does not wait for one that died or is silent: the old buffer stays in use, and the new one is adopted at the
first update that finds it there. `Adoptions` keeps which one that was, so that what is computed again does the same.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import flatten_arrays, select_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.driver.adoptions import NEVER, Adoptions
from kinetix_dist.runtime.driver.clock import RoleClock
from kinetix_dist.runtime.driver.roles import Curator, Reporter, Trainer
from kinetix_dist.runtime.driver.run_data import RunData
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.stopping import StopSignals
from kinetix_dist.runtime.driver.weight_sync import nested, resolve

# Arrays of a checkpoint: weights of the refresh that was in flight, and what it works from beside them.
PENDING, PENDING_INPUT = "pending", "pending_input"
# s that a curator at work may be silent, since its process can be short of a core; or an update, where that is longer
MIN_PATIENCE_S = 3.0
MAX_EARLY_S = 5.0  # that a refresh may hold up a checkpoint, also of a run that was asked to stop


class Refreshes:
    """Of one run. Without a curator nothing is ever asked for."""

    def __init__(
        self,
        config: TrainConfig,
        run: RunDirectory,
        reporter: Reporter,
        trainer: Trainer,
        curator: Curator | None,
        *,
        clock: RoleClock,
        stop: StopSignals,
        data: RunData,
    ) -> None:
        self._config = config.curriculum
        self._schedule = config.schedule
        self._has_input = config.curriculum_class.refreshes_from_state
        self._log = config.curriculum_log
        self._data = data
        self._run = run
        self._reporter = reporter
        self._trainer = trainer
        self._curator = curator
        self._clock = clock
        self._stop = stop
        self._section = trainer.backend.sections.section
        self._adoptions = Adoptions(run)
        # Refresh in flight: policy version, weights, what it works from or None.
        self._pending: tuple[int, Any, Any] | None = None
        self._is_stale = False
        self._scoring_seconds: float | None = None  # of the buffer in use
        self._curated_for = -1  # the update before which all was done last
        # s that refreshes were waited for, the last ones since the processes started, by the programs that they run
        self._taken_in: dict[tuple[int, bool], float] = {}

    def start(self, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """As a checkpoint has it; afresh where both are empty. What was in flight is asked for again."""
        self._pending, self._taken_in = None, {}
        self._curated_for = description.get("curated_for", -1)
        self._is_stale = description.get("buffer_is_stale", False)
        self._scoring_seconds = description.get("scoring_seconds")
        version = description.get("refresh_in_flight")
        if version is not None and self._curator is not None:
            given = nested(select_arrays(arrays, PENDING_INPUT))
            self._request(version, nested(select_arrays(arrays, PENDING)), given or None)

    def ask_for_first(self) -> None:
        """Of a run that begins, before its first update: a curator starts, compiles and scores while others do. Where
        nothing is done at the same time, that would only come before the first evaluation."""
        if self._curator is not None and self._curator.works_beside:
            self._request(0, self._trainer.weights(), None)

    def cancel(self) -> None:
        """All processes of the trainer are started again."""
        if self._curator is not None:
            self._curator.cancel()

    @property
    def may_be_early(self) -> bool:
        """Whether what is to be done before the next update may as well be done before a checkpoint: nothing is worked
        out beside training, no batch is drawn ahead, and a refresh that would have to be waited for has all programs
        compiled and is quick."""
        if self._curator is None or self._curator.works_beside or self._trainer.policy_lag or self._has_input:
            return False
        return self._pending is None or self._taken_in.get(self._programs(self._pending[0]), math.inf) < MAX_EARLY_S

    def _programs(self, policy_version: int) -> tuple[int, bool]:
        """What decides which programs a refresh runs: the phase that it is for, and whether it has a probe."""
        phase = self._schedule.at(self._config.adopted_at(policy_version))
        return phase.number, self._has_probe(policy_version)

    def _has_probe(self, policy_version: int) -> bool:
        return self._log.has_probe(policy_version // self._config.refresh_every)

    def curate(self, num_updates: int, *, update_seconds: float) -> None:
        """Before update `num_updates`, once: asks for a refresh and adopts one. update_seconds: of the update
        before."""
        if self._curator is None or self._curated_for == num_updates:
            return
        self._curator.watch()
        is_asked_for = self._pending is not None and self._pending[0] == num_updates
        self._adopt_if_due(num_updates, update_seconds)
        if self._config.is_refresh_due(num_updates) and not is_asked_for:
            self._give_up_late(num_updates)
            given = self._trainer.refresh_input() if self._has_input and num_updates else None
            self._request(num_updates, self._trainer.weights(), given)
            self._adopt_if_due(num_updates, update_seconds)
        self._curated_for = num_updates

    def end(self, num_updates: int) -> None:
        """Training is over after so many. A late buffer was not used, and must not be where this is computed again."""
        if self._pending is None:
            return
        version, drawn_last = self._pending[0], num_updates - 1 + self._trainer.policy_lag
        if self._adoptions.get(version) is None and self._config.adopted_at(version) <= drawn_last:
            self._adoptions.record(version, NEVER)

    def description(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "curated_for": self._curated_for,
            "refresh_in_flight": self._pending[0] if self._pending is not None else None,
            "buffer_is_stale": self._is_stale,
            "scoring_seconds": self._scoring_seconds,
        }

    def in_flight(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint."""
        if self._pending is None or self._curator is None:
            return {}
        _, weights, given = self._pending
        return flatten_arrays({PENDING: resolve(weights), PENDING_INPUT: resolve(given)})

    def buffer_of(self, batch: int) -> int | None:
        """Policy version of the buffer that the levels of a batch were drawn from; None where there is no such."""
        return self._adoptions.in_use(batch)

    def metrics(self) -> dict[str, float]:
        metrics = {}
        if self._curator is not None:
            metrics["curriculum/buffer_is_stale"] = float(self._is_stale)
        if self._scoring_seconds is not None:
            metrics["curriculum/scoring_seconds"] = self._scoring_seconds
        return metrics

    def _request(self, policy_version: int, weights: Any, given: Any) -> None:
        assert self._curator is not None
        self._pending = (policy_version, weights, given)
        if not policy_version and not self._curator.works_beside:
            self._reporter.phase("curating")
        with self._clock.role("curate"):
            # Of the buffer that is in use now: what this refresh replaces.
            probe = self._trainer.probe(self._log.probe_levels) if self._has_probe(policy_version) else None
            self._curator.request(weights, policy_version, probe, given)

    def _adopt_if_due(self, num_updates: int, update_seconds: float) -> None:
        if self._pending is None:
            return
        assert self._curator is not None
        version = self._pending[0]
        drawn_next = num_updates + self._trainer.policy_lag  # the batch whose levels are drawn now
        recorded = self._adoptions.get(version)
        if drawn_next < (recorded if recorded is not None else self._config.adopted_at(version)):
            return
        if version == 0 and self._curator.works_beside:
            self._reporter.phase("curating")
        # Without a first buffer there is nothing to play, and what is recorded is repeated as it was.
        must_wait = version == 0 or recorded is not None
        patience_s = None if must_wait else max(MIN_PATIENCE_S, update_seconds)
        began = time.monotonic()
        with self._section("curate"), self._clock.role("curate"), self._may_stop():
            refresh = self._curator.take(patience_s=patience_s, meanwhile=self._trainer.check)
        if refresh is None:
            self._note_late(version, num_updates)
            return
        self._taken_in[self._programs(version)] = time.monotonic() - began
        if self._trainer.policy_lag:
            self._stop.raise_if_requested()  # it stays in flight: the batch drawn ahead is not from this buffer
        with self._section("curate"):
            self._trainer.adopt(refresh.parts)
        self._is_stale, self._pending = False, None
        self._scoring_seconds = refresh.seconds
        first = drawn_next if version else 0  # nothing was drawn before the first one, whatever the policy lag
        self._adoptions.record(version, first)
        self._run.event("buffer_adopted", policy_version=version, update=first)
        self._data.adopted(refresh, num_updates=num_updates, first_batch=first)

    def _may_stop(self) -> AbstractContextManager[None]:
        """Waiting can be broken off at a signal; what this process or the workers are in the middle of is finished."""
        assert self._curator is not None
        return self._stop.interruptible() if self._curator.works_beside else nullcontext()

    def _note_late(self, version: int, num_updates: int) -> None:
        if not self._is_stale:
            self._run.event("buffer_late", policy_version=version, update=num_updates)
            self._reporter.note(f"the buffer of policy version {version} is late: the old one stays in use until then")
        self._is_stale = True

    def _give_up_late(self, num_updates: int) -> None:
        """A refresh that has not come when the next one is asked for."""
        if self._pending is None:
            return
        assert self._curator is not None
        version = self._pending[0]
        self._curator.cancel()
        self._adoptions.record(version, NEVER)
        self._run.event("refresh_lost", policy_version=version, update=num_updates)
        self._pending = None
