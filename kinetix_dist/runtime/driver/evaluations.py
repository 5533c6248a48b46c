"""Evaluations and recordings during training: by a process in the background, or inline in local mode.

| consumes | weights of the updates at which one is due |
|---|---|
| produces | solve rates, in the metrics of a later update, with their update; rollouts, which `Recorder` writes |
| waits for | nothing; after the last update, for all that was requested |
| bound | MAX_WAITING requests, since each holds weights: one beyond that is left out, with an event |

Requests are part of a checkpoint, so that a resumed run makes them again. A lost evaluator is replaced, and does again
what it was doing.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import flatten_arrays, select_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import one_line
from kinetix_dist.runtime.cores.build import build_evaluator
from kinetix_dist.runtime.cores.evaluator import EvaluatorCore
from kinetix_dist.runtime.cores.run_names import nested
from kinetix_dist.runtime.driver.roles import Trainer
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.totals import RoleClock
from kinetix_dist.runtime.processes.backend import BackgroundProcess
from kinetix_dist.runtime.processes.calls import resolve
from kinetix_dist.runtime.processes.failures import WorkerLostError
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.telemetry.recording import Rollout
from kinetix_dist.telemetry.sinks import evaluation_rates
from kinetix_dist.telemetry.sinks.mcap import McapSink

MAX_WAITING = 4
POLL_S = 0.02
EVALUATING = "evaluating"  # arrays of a checkpoint: weights of the requests
EVALUATE, RECORD = "evaluate", "record"
METHODS: Mapping[str, Callable[[EvaluatorCore, Any, int], tuple[Mapping[str, Any], Any]]] = {
    EVALUATE: EvaluatorCore.evaluate,
    RECORD: EvaluatorCore.record,
}
LOOKED_UNTIL = "evaluations_looked_until"  # in a checkpoint: s of training after its warm-up, see `Due`


@dataclasses.dataclass(frozen=True)
class _Job:
    kind: str
    update: int  # whose weights
    weights: Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluated:
    """An evaluation that has come."""

    update: int  # whose weights
    rates: Mapping[str, Mapping[str, Any]]  # as `Evaluator.evaluate` gives them
    seconds: float


class Evaluations(BackgroundProcess[EvaluatorCore]):
    """Evaluations and recordings of one run by the evaluator process."""

    def __init__(
        self,
        config: TrainConfig,
        trainer: Trainer,
        plan: ProcessPlan,
        *,
        on_event: Callable[..., None],
        on_rollouts: Callable[[list[Any]], None],
    ) -> None:
        super().__init__(config, trainer.backend, plan)
        self._trainer = trainer
        self._on_event = on_event
        self._on_rollouts = on_rollouts
        self._due = Due(config)
        self._jobs: list[_Job] = []  # the first one is what the process is at

    def start(self, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Starts as a checkpoint says; afresh where both are empty."""
        self._call = None  # what the process is at is not waited for any more
        self._due.start(description)
        requested = description.get("evaluations_in_flight", [])
        weights = [nested(select_arrays(arrays, f"{EVALUATING}/{index}")) for index in range(len(requested))]
        put = self._backend.put
        self._jobs = [_Job(kind, update, put(tree)) for (kind, update), tree in zip(requested, weights, strict=True)]

    def after_update(self, num_updates: int, seconds: float, clock: RoleClock, *, is_last: bool) -> list[Evaluated]:
        """Asks for what is due. One evaluation that has come since, if any; after the last update waits for all.

        seconds: of training after its warm-up."""
        with self._backend.sections.section("evaluate"), clock.role("evaluate"):
            self._request_due(num_updates, seconds)
            return self._collected(must_wait=is_last)

    def _request_due(self, num_updates: int, seconds: float) -> None:
        due = self._due.after(num_updates, seconds)
        if not due:
            return
        weights = self._backend.put(resolve(self._trainer.weights()))  # a copy of its own: the trainer may be lost
        for kind in due:
            if len(self._jobs) < MAX_WAITING:
                self._jobs.append(_Job(kind, num_updates, weights))
            else:
                self._on_event("evaluation_left_out", what=kind, update=num_updates)

    def _collected(self, *, must_wait: bool) -> list[Evaluated]:
        evaluated: list[Evaluated] = []
        while self._jobs and (must_wait or not evaluated):
            if self._call is None:
                self._send()
            if self._is_answered(must_wait=must_wait):
                evaluated += self._taken()
            elif must_wait:
                time.sleep(POLL_S)
            else:
                break
        return evaluated

    def description(self) -> dict[str, Any]:
        """Description for a checkpoint."""
        return {"evaluations_in_flight": [[job.kind, job.update] for job in self._jobs], **self._due.description()}

    def in_flight(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint."""
        return flatten_arrays({EVALUATING: {str(i): resolve(job.weights) for i, job in enumerate(self._jobs)}})

    def _send(self) -> None:
        job = self._jobs[0]
        evaluator = self._started(build_evaluator)
        self._call = evaluator.call_with_header(METHODS[job.kind], job.weights, job.update)

    def _is_answered(self, *, must_wait: bool) -> bool:
        assert self._call is not None
        try:
            self._silence(is_waited_for=must_wait)
            return self._call[0].is_ready()
        except WorkerLostError as error:
            self._replace(error)
            return False

    def _taken(self) -> list[Evaluated]:
        assert self._call is not None
        job = self._jobs[0]
        answers: list[Any] = self._backend.gather(self._call)
        header, content = answers
        self._jobs.pop(0)
        self._call = None
        self._note_recovery()
        if job.kind == RECORD:
            self._on_rollouts(content)
            return []
        return [Evaluated(update=job.update, rates=content, seconds=header["seconds"])]

    def _replace(self, error: WorkerLostError) -> None:
        """The next look starts another process, which does again what this one was at."""
        error.process, error.section = self._plan.name, "evaluate"
        self.stop()
        if self._backend.has_lost_resources:  # it went with its node: the whole run is placed again
            raise error
        self._losses.append(self._backend.losses.lost(error))
        self._backend.sections.begin_again()


class InlineEvaluations:
    """The same by the trainer while training waits: local mode has no other process."""

    def __init__(
        self,
        config: TrainConfig,
        evaluate: Callable[..., Mapping[str, Mapping[str, Any]]],
        record: Callable[[int], None],
    ) -> None:
        self._num_rollouts = config.recording.num_rollouts
        self._evaluate = evaluate
        self._record = record
        self._due = Due(config)

    def start(self, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Nothing is ever in flight."""
        del arrays
        self._due.start(description)

    def after_update(self, num_updates: int, seconds: float, clock: RoleClock, *, is_last: bool) -> list[Evaluated]:
        del clock, is_last
        due, evaluated = self._due.after(num_updates, seconds), []
        if EVALUATE in due:
            began = time.monotonic()
            rates = self._evaluate(use_policy=True)
            evaluated.append(Evaluated(update=num_updates, rates=rates, seconds=time.monotonic() - began))
        if RECORD in due:
            self._record(self._num_rollouts)
        return evaluated

    def description(self) -> dict[str, Any]:
        return self._due.description()

    def in_flight(self) -> dict[str, np.ndarray]:
        return {}


class Due:
    """Schedule: which of EVALUATE and RECORD are due after an update.

    An evaluation that came due by time at an update which was saved without looking, since the run was stopped in it,
    is due at the next.
    """

    def __init__(self, config: TrainConfig) -> None:
        self._every = {EVALUATE: config.evaluation.every, RECORD: config.recording.every}
        self._every_seconds = config.evaluation.every_seconds
        self._seconds: float | None = None  # up to where it was looked

    def start(self, description: Mapping[str, Any]) -> None:
        """Starts as a checkpoint says; afresh where it has nothing."""
        self._seconds = description.get(LOOKED_UNTIL)

    def description(self) -> dict[str, Any]:
        """Description for a checkpoint."""
        return {LOOKED_UNTIL: self._seconds}

    def after(self, num_updates: int, seconds: float) -> list[str]:
        """Kinds due after so many updates; seconds: of training after its warm-up.

        Evaluations by time are due at the first update at or after each multiple of every_seconds.
        """
        due = [kind for kind, every in self._every.items() if every and num_updates % every == 0]
        every, before, self._seconds = self._every_seconds, self._seconds, seconds
        if every and before is not None and seconds // every > before // every:
            due.insert(0, EVALUATE)
        return due


def evaluation_metrics(rates: Mapping[str, Mapping[str, Any]], num_updates: int) -> dict[str, float]:
    """Metrics of an evaluation (`telemetry.names`). rates: by level set, of the weights after so many updates."""
    return evaluation_rates(rates) | {"evaluation/update": float(num_updates)}


def summaries(rates: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """The same for reports and events: without the counts of each level."""
    return {name: {k: v for k, v in rate.items() if k != "levels"} for name, rate in rates.items()}


class Recorder:
    """One file a recording, named by the policy version; no file is ever overwritten."""

    def __init__(self, run: RunDirectory) -> None:
        self._run = run
        self.last: list[Rollout] = []
        self.last_file: Path | None = None

    def __call__(self, rollouts: Sequence[Rollout]) -> None:
        if not rollouts:
            return
        self.last = list(rollouts)
        try:
            self._write(rollouts)
        except OSError as error:  # training is worth more than a recording of it
            self._run.event("recording_failed", path=str(self._run.recordings), error=one_line(error))

    def _write(self, rollouts: Sequence[Rollout]) -> None:
        self._run.recordings.mkdir(exist_ok=True)
        stem = f"update_{rollouts[0].policy_version:06d}"
        path = self._run.recordings / f"{stem}.mcap"
        number = 1
        while path.exists():
            number += 1
            path = self._run.recordings / f"{stem}-{number}.mcap"
        with McapSink(path, max_queued=max(len(rollouts), 1), on_event=self._event) as sink:
            for rollout in rollouts:
                sink.write(rollout)
        self.last_file = path
        update = rollouts[0].policy_version
        self._run.event("recorded", update=update, file=path.name, rollouts=len(rollouts))

    def make_pictures(self) -> str | None:
        """`solved.rrd`, `solved.png`, `failed.rrd`, `failed.png` of the last recording, where it has such rollouts. One
        line where that cannot be: a trained policy is worth more than pictures of it."""
        try:
            self._draw()
        except (ImportError, OSError) as error:
            self._run.event("pictures_failed", error=one_line(error))
            return f"no pictures of rollouts: {one_line(error)}; `kinetix-dist replay {self._run.path}` tries again"
        return None

    def _draw(self) -> None:
        from kinetix_dist.telemetry.pictures import write_rollout_picture
        from kinetix_dist.telemetry.sinks.rerun import rollout_to_rrd

        for name, wanted in (("solved", True), ("failed", False)):
            rollout = next((rollout for rollout in self.last if rollout.solved == wanted), None)
            if rollout is None:
                continue
            rollout_to_rrd(rollout, self._run.recordings / f"{name}.rrd")
            write_rollout_picture(self._run.recordings / f"{name}.png", rollout)

    def _event(self, name: str, fields: dict[str, Any]) -> None:
        self._run.event(name, **fields)
