"""Refreshes of the curriculum: requested, worked out, taken and adopted.

    Refreshes (the schedule)  --request(weights of version k)-->  CuratorClient: `run.num_curators` CuratorProcesses
                              <--take(): Refresh----------------   or WorkerCurator (`run.num_curators` 0)
    Refreshes  --adopt(parts)-->  trainer;  Adoptions keeps the update in adoptions.json

A refresh requested at update k is adopted at update k + adopt_after, whatever the timing: training waits for a curator
at work. It does not wait for one that died or is silent: the old buffer stays in use, and the new one is adopted at the
first update that finds it there. `Adoptions` records that update, so that what is computed again does the same. The
first refresh of a state of the curriculum, of the run or of a phase, is always waited for (`config/refresh_times.py`).

| curator | consumes | produces | waits for | bound |
|---|---|---|---|---|
| processes of their own | weights of a version | parts of a refresh, one a process | nothing | one call a process |
| workers | weights of a version | parts, one a worker with a batch of candidates | the slowest worker | one refresh |

A process that is lost is replaced, and its part is requested again with the same weights and key: the answer is
identical, later. A request made while a process works on a refresh that was given up is sent after it, and replaces the
request before: calls never pile up at a late curator.

On a GPU two processes take turns, and scoring in the background costs more than the time it takes alone: then workers
score between two updates, right before the buffer is adopted. Both ways give the same run bit for bit. A resumed run
makes its first update without waiting for a refresh.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np

from kinetix_dist.checkpoint import flatten_arrays, select_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.config.phases import Phase
from kinetix_dist.errors import one_line
from kinetix_dist.runtime.cores.build import build_curator
from kinetix_dist.runtime.cores.curator_core import CuratorCore
from kinetix_dist.runtime.cores.run_names import nested
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.roles import Curator, Refresh, Trainer
from kinetix_dist.runtime.driver.run_data import RunData
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.stopping import StopSignals
from kinetix_dist.runtime.driver.totals import RoleClock
from kinetix_dist.runtime.processes.backend import Backend, BackgroundProcess
from kinetix_dist.runtime.processes.calls import Future, resolve
from kinetix_dist.runtime.processes.failures import InputLostError, WorkerLostError
from kinetix_dist.runtime.processes.placement import ProcessPlan

NEVER = math.inf


class Adoptions:
    """Updates that first used each refresh, or NEVER, by its policy version: adoptions.json of a run.

    The record is part of what a run's numbers depend on: computing again, after a loss or with --resume, follows it.
    """

    def __init__(self, run: RunDirectory) -> None:
        self._run = run
        found = run.read_json(run.adoptions_path, is_whole=_are_adoptions) or {}
        self._at = {int(version): NEVER if update is None else update for version, update in found.items()}

    def get(self, policy_version: int) -> float | None:
        """None where nothing is recorded yet."""
        return self._at.get(policy_version)

    def in_use(self, update: int) -> int | None:
        """The newest version that was adopted by that update; None where none ever was. Nothing can be played before
        the first one: it is in use from the beginning, also where an earlier version recorded it from update 1 on."""
        return max((version for version, at in self._at.items() if at <= update), default=min(self._at, default=None))

    def record(self, policy_version: int, update: float) -> None:
        """A disk that does not take it is an event: the record is complete with the next one that is written."""
        if self._at.get(policy_version) == update:
            return
        self._at[policy_version] = update
        content = {str(version): None if at == NEVER else at for version, at in self._at.items()}
        try:
            self._run.write_json(self._run.adoptions_path, content)
        except OSError as error:
            self._run.event("file_failed", file=self._run.adoptions_path.name, error=one_line(error))


def _are_adoptions(content: Any) -> bool:
    """{"3": 5, "6": null}"""
    return isinstance(content, dict) and all(
        version.isdecimal() and (update is None or isinstance(update, int)) for version, update in content.items()
    )


# Arrays of a checkpoint: weights of the refresh that was in flight, and its other input.
PENDING, PENDING_INPUT = "pending", "pending_input"
# s that a curator at work may be silent, since its process can be short of a core; or an update, where that is longer
MIN_PATIENCE_S = 3.0
MAX_EARLY_S = 5.0  # that a refresh may hold up a checkpoint, also of a run that is to stop


class Refreshes:
    """Schedule of the refreshes of one run. Without a curator none is ever requested."""

    def __init__(
        self,
        config: TrainConfig,
        data: RunData,
        trainer: Trainer,
        curator: Curator | None,
        *,
        clock: RoleClock,
        stop: StopSignals,
    ) -> None:
        self._schedule = config.schedule
        self._times = config.refresh_times
        self._log = config.curriculum_log
        self._data = data
        self._run = data.run
        self._reporter = data.reporter
        self._trainer = trainer
        self._curator = curator
        self._clock = clock
        self._stop = stop
        self._section = trainer.backend.sections.section
        self._adoptions = Adoptions(data.run)
        # Refresh in flight: policy version, weights, what it works from or None.
        self._pending: tuple[int, Any, Any] | None = None
        self._is_stale = False
        self._scoring_seconds: float | None = None  # of the buffer in use
        self._curated_for = -1  # the update before which all was done last
        # s that refreshes were waited for, the last ones since the processes started, by the programs that they run
        self._taken_in: dict[tuple[int, bool], float] = {}

    def start(self, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Starts as a checkpoint says; afresh where both are empty. A refresh that was in flight is requested again."""
        self._pending, self._taken_in = None, {}
        self._curated_for = description.get("curated_for", -1)
        self._is_stale = description.get("buffer_is_stale", False)
        self._scoring_seconds = description.get("scoring_seconds")
        version = description.get("refresh_in_flight")
        if version is not None and self._curator is not None:
            given = nested(select_arrays(arrays, PENDING_INPUT))
            self._request(version, nested(select_arrays(arrays, PENDING)), given or None)

    def request_first(self) -> None:
        """Requests the first refresh of a new run before its first update: a curator starts, compiles and scores
        meanwhile.

        Where nothing is done at the same time, that would only come before the first evaluation.
        """
        if self._curator is not None and self._curator.works_in_background and self._times.is_due(0):
            self._request(0, self._trainer.weights(), None)

    def cancel(self) -> None:
        """All processes of the trainer are started again."""
        if self._curator is not None:
            self._curator.cancel()

    def may_be_early(self, num_updates: int) -> bool:
        """Says whether the refresh before the update after `num_updates` may as well be made before a checkpoint.

        So it is where no process works in the background, no batch is drawn ahead, and a refresh that would have to be
        waited for has all programs compiled and is quick.
        """
        if self._curator is None or self._curator.works_in_background or self._trainer.policy_lag:
            return False
        version = num_updates if self._pending is None else self._pending[0]
        if self._has_input(version):
            return False
        begins = self._times.is_due(num_updates) and self._times.is_first(num_updates)  # requested and taken at once
        if self._pending is None and not begins:
            return True
        return self._taken_in.get(self._programs(version), math.inf) < MAX_EARLY_S

    def _phase(self, policy_version: int) -> Phase[TrainConfig]:
        """Phase in which a refresh is adopted."""
        return self._schedule.at(self._times.adopted_at(policy_version))

    def _has_input(self, policy_version: int) -> bool:
        return self._phase(policy_version).config.curriculum_class.refreshes_from_state

    def _programs(self, policy_version: int) -> tuple[int, bool]:
        """Key of the programs that a refresh runs: the phase that it is for, and whether it has a probe."""
        return self._phase(policy_version).number, self._has_probe(policy_version)

    def _has_probe(self, policy_version: int) -> bool:
        return self._log.has_probe(self._times.number(policy_version))

    def curate(self, num_updates: int, *, update_seconds: float) -> None:
        """Before update `num_updates`, once: requests a refresh and adopts one. update_seconds: of the update
        before."""
        if self._curator is None or self._curated_for == num_updates:
            return
        self._curator.watch()
        if self._pending is not None and self._times.is_over(self._pending[0], num_updates + self._trainer.policy_lag):
            self._give_up(num_updates)  # a late one
            self._is_stale = False
        is_requested = self._pending is not None and self._pending[0] == num_updates
        self._adopt_if_due(num_updates, update_seconds)
        if self._times.is_due(num_updates) and not is_requested:
            if self._pending is not None:
                self._give_up(num_updates)
            has_input = self._has_input(num_updates) and not self._times.is_first(num_updates)
            given = self._trainer.refresh_input() if has_input else None
            self._request(num_updates, self._trainer.weights(), given)
            self._adopt_if_due(num_updates, update_seconds)
        self._curated_for = num_updates

    def end(self, num_updates: int) -> None:
        """Training is over after so many. A late buffer was not used, and must not be where this is computed again."""
        if self._pending is None:
            return
        version, drawn_last = self._pending[0], num_updates - 1 + self._trainer.policy_lag
        if self._adoptions.get(version) is None and self._times.adopted_at(version) <= drawn_last:
            self._adoptions.record(version, NEVER)

    def description(self) -> dict[str, Any]:
        """Description for a checkpoint."""
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
        return self._adoptions.in_use(batch) if self._refreshes(batch) else None

    def _refreshes(self, update: int) -> bool:
        return self._schedule.at(update).config.curriculum_class.refreshes

    def metrics(self, update: int) -> dict[str, float]:
        """Metrics of an update, 0 for the first."""
        metrics: dict[str, float] = {}
        if not self._refreshes(update):
            return metrics
        if self._curator is not None:
            metrics["curriculum/buffer_is_stale"] = float(self._is_stale)
        if self._scoring_seconds is not None:
            metrics["curriculum/scoring_seconds"] = self._scoring_seconds
        return metrics

    def _request(self, policy_version: int, weights: Any, given: Any) -> None:
        assert self._curator is not None
        self._pending = (policy_version, weights, given)
        if self._times.is_first(policy_version) and not self._curator.works_in_background:
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
        if drawn_next < (recorded if recorded is not None else self._times.adopted_at(version)):
            return
        is_first = self._times.is_first(version)
        if is_first and self._curator.works_in_background:
            self._reporter.phase("curating")
        # Without a first buffer there is nothing to play, and what is recorded is repeated as it was.
        must_wait = is_first or recorded is not None
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
        return self._stop.interruptible() if self._curator.works_in_background else nullcontext()

    def _note_late(self, version: int, num_updates: int) -> None:
        if not self._is_stale:
            self._run.event("buffer_late", policy_version=version, update=num_updates)
            self._reporter.note(f"the buffer of policy version {version} is late: the old one stays in use until then")
        self._is_stale = True

    def _give_up(self, num_updates: int) -> None:
        """Gives up a refresh that has not come when the next one is due, or another state of the curriculum begins."""
        assert self._curator is not None and self._pending is not None
        version = self._pending[0]
        self._curator.cancel()
        self._adoptions.record(version, NEVER)
        self._run.event("refresh_lost", policy_version=version, update=num_updates)
        self._pending = None


POLL_S = 0.02


class CuratorClient:
    """A `roles.Curator`."""

    def __init__(self, config: TrainConfig, backend: Backend, plans: Sequence[ProcessPlan]) -> None:
        self._config = config
        self._backend = backend
        self.place(plans)

    @property
    def works_in_background(self) -> bool:
        return self._backend.works_in_background

    def place(self, plans: Sequence[ProcessPlan]) -> None:
        self.processes = [
            CuratorProcess(self._config, self._backend, plan, part=part, num_parts=len(plans))
            for part, plan in enumerate(plans)
        ]
        self.cancel()

    def request(self, weights: Any, policy_version: int, probe: Any, given: Any) -> None:
        stored, given = self._stored(weights), None if given is None else self._stored(given)
        for process in self.processes:
            # The last one has no more batches to score than the others.
            process.request(stored, policy_version, probe if process is self.processes[-1] else None, given)
        self._missing, self._parts = set(self.processes), {}

    def _stored(self, content: Any) -> Future[Any]:
        return content if isinstance(content, Future) else self._backend.put(content)

    def watch(self) -> None:
        for process in self.processes:
            process.watch()

    def take(self, *, patience_s: float | None, meanwhile: Callable[[], None] = lambda: None) -> Refresh | None:
        while self._missing:
            meanwhile()
            for process in [*self._missing]:
                if part := process.poll(patience_s):
                    self._parts[process] = part
                    self._missing.remove(process)
            if patience_s is not None and any(process.is_late for process in self._missing):
                return None
            if self._missing:
                time.sleep(POLL_S)
        if not self._parts:
            return None
        parts, headers = zip(*(self._parts[process] for process in self.processes), strict=True)
        self._parts = {}
        return Refresh.of(parts, headers)

    def cancel(self) -> None:
        for process in self.processes:
            process.cancel()
        self._missing: set[CuratorProcess] = set()  # those that have not answered the last request
        self._parts: dict[CuratorProcess, tuple[Future[Any], dict[str, Any]]] = {}  # those that have: parts, headers

    def facts(self) -> list[dict[str, Any]]:
        return [fact for process in self.processes for fact in process.facts()]

    def stop(self) -> None:
        for process in self.processes:
            process.stop()


class CuratorProcess(BackgroundProcess[CuratorCore]):
    """Part `part` of `num_parts` of every refresh."""

    def __init__(self, config: TrainConfig, backend: Backend, plan: ProcessPlan, *, part: int, num_parts: int) -> None:
        super().__init__(config, backend, plan)
        self._part, self._num_parts = part, num_parts
        # Of the refresh that is wanted: weights, version, levels to play again or None, what it works from or None.
        self._requested: tuple[Future[Any], int, Any, Any] | None = None
        self._is_wanted = False  # whether what the process is at is the refresh that is wanted
        self.is_late = False  # it was lost or waited for in vain, and has not answered since

    def request(self, weights: Future[Any], policy_version: int, probe: Any, given: Any) -> None:
        """Starts a refresh; does not wait where there is a process to do it."""
        self.cancel()
        self._requested = (weights, policy_version, probe, given)
        if self._call is None:
            self._send()
        else:
            self._look()

    def watch(self) -> None:
        """Replaces a process that died, without waiting; its request is made again."""
        if self._call is not None:
            self._look()

    def poll(self, patience_s: float | None) -> tuple[Future[Any], dict[str, Any]] | None:
        """Part of the refresh and its timing, see `CuratorCore.refresh`; None where it is not there yet. Does not wait.

        The process `is_late` where it was lost, or is silent for more than `patience_s`.
        """
        assert self._call is not None
        header, refreshed = self._call
        is_ready = self._is_wanted and header.is_ready()
        silence = self._look()
        if is_ready and silence is not None:
            return refreshed, self._taken(header)
        if patience_s is not None and (silence is None or silence > patience_s):
            self.is_late = True
        return None

    def cancel(self) -> None:
        """Gives up the refresh that was requested."""
        self._requested, self._is_wanted = None, False

    def facts(self) -> list[dict[str, Any]]:
        """Facts of its process; a loss is one too, since training does not depend on it."""
        if self._handle is None or not self._backend.works_in_background:
            return []
        try:
            return self._backend.facts([self._handle])
        except WorkerLostError as error:
            return [{"process": self._plan.name, "lost": str(error)}]

    def _look(self) -> float | None:
        """Seconds for which the process has been silent; None where it is lost, and replaced by now."""
        assert self._call is not None
        try:
            silence = self._silence(is_waited_for=True)
            is_answered = self._call[0].is_ready()
        except InputLostError:
            if self._is_wanted:
                raise
            silence, is_answered = 0.0, True
        except WorkerLostError as error:
            self._replace(error)
            return None
        if is_answered and not self._is_wanted:
            self._call = None
            self.is_late = False  # it is at work again, and waited for
            if self._requested is not None:
                self._send()
        return silence

    def _taken(self, header: Future[dict[str, Any]]) -> dict[str, Any]:
        taken = self._backend.gather([header])[0]
        self._prepare()
        self._call = self._requested = None
        self._is_wanted = self.is_late = False
        self._note_recovery()
        return taken

    def _prepare(self) -> None:
        """Compiles the probe in a process that has not played one, as in the first refresh, while it has
        nothing to do, once. Nobody waits for it, and what fails there fails again where it is waited for."""
        assert self._requested is not None and self._handle is not None
        _, policy_version, probe, _ = self._requested
        takes_probes = self._part == self._num_parts - 1 and self._config.curriculum_log.probe_levels > 0
        if takes_probes and probe is None and self._backend.works_in_background:
            times = self._config.refresh_times
            later = times.next(policy_version + 1)
            if later is not None and not times.is_first(later):
                self._handle.call(CuratorCore.prepare, later)

    def _send(self) -> None:
        assert self._requested is not None
        weights, policy_version, probe, given = self._requested
        self._call = self._started(build_curator).call_with_header(
            CuratorCore.refresh, weights, policy_version, self._part, self._num_parts, probe, given
        )
        self._is_wanted = True

    def _replace(self, error: WorkerLostError) -> None:
        """Starts another process and requests again, without waiting for either."""
        error.process, error.section = self._plan.name, "curate"
        if self._backend.has_lost_resources:  # it went with its node: the whole run is placed again
            self.stop()
            raise error
        self._losses.append(self._backend.losses.lost(error))
        self.is_late = True
        self.stop()
        if self._requested is None:  # the next request starts it
            return
        weights, policy_version, *others = self._requested
        put, again = self._backend.put, [resolve(other) for other in others]
        # Their first copies may be gone.
        probe, given = (None if other is None else put(other) for other in again)
        self._requested = put(resolve(weights)), policy_version, probe, given
        self._backend.sections.begin_again()
        self._send()


class _Request(NamedTuple):
    """Arguments of `ColocatedTrainer.refresh`."""

    weights: Any
    policy_version: int
    probe: Any
    given: Any


class WorkerCurator:
    """Curator of a run whose workers learn, play and score: a `roles.Curator` without a process of its own."""

    works_in_background = False

    def __init__(self, trainer: ColocatedTrainer) -> None:
        self._trainer = trainer
        self._request: _Request | None = None

    def request(self, weights: Any, policy_version: int, probe: Any, given: Any) -> None:
        self._request = _Request(weights, policy_version, probe, given)

    def watch(self) -> None:
        pass

    def take(self, *, patience_s: float | None, meanwhile: Callable[[], None] = lambda: None) -> Refresh | None:
        """Works out the refresh that was requested."""
        del patience_s, meanwhile
        assert self._request is not None, "a refresh is requested before it is taken"
        refresh = self._trainer.refresh(*self._request)
        self._request = None
        return refresh

    def cancel(self) -> None:
        self._request = None

    def facts(self) -> list[dict[str, Any]]:
        return []

    def stop(self) -> None:
        pass
