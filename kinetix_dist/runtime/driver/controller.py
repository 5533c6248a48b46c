"""The loop of a training run. Read this first.

                       weights, version k                       buffer scored by version k
        trainer  ------------------------------->  curator  -------------------------------.
       (workers: worlds + learner shard, or                (scores while training goes on)  |
        rollout actors -> work buffer -> learner)  <----------------------------------------'
           |                                            adopted at update k + adopt_after, always
           |  metrics, outcomes                         (0 for the first), whatever the timing
           v
        controller -> metrics/ checkpoints/ recordings/ report.json        (the run directory is the truth)

One loop a role:

| role | consumes | produces | waits for | unblocked by |
|---|---|---|---|---|
| controller | metrics of an update | orders | the trainer; a buffer that is due | an answer, a loss, a time limit |
| trainer | weights, buffer | the next weights | its workers (colocated) or whole batches (split) | the slowest worker |
| curator | weights of version k, key k | a buffer | nothing | - |

With `run.num_curators` 0 the workers of the trainer are the curator, between two updates, and an update waits for them.
The controller is the same for all placements: it drives a `Trainer` and a `Curator`, which are plain objects in local
mode and Ray actors behind a handle otherwise. It holds no state that is not in the last checkpoint, so a lost worker,
and a lost driver are the same case, whatever the run was at: restore, re-issue what was in flight, come back to that
update, repeat what was cut off. Training waits for a curator at work, but not for one that was lost: its buffer comes
later, from an update on that adoptions.json keeps.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from kinetix_dist.checkpoint import Checkpoint, remove_dead_drafts
from kinetix_dist.config import TrainConfig, to_dict
from kinetix_dist.runtime.driver.checkpoints import LINEAGE, Saver, newest_checkpoint, starting_point
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.evaluations import (
    Evaluated,
    Evaluations,
    InlineEvaluations,
    evaluation_metrics,
    summaries,
)
from kinetix_dist.runtime.driver.refreshes import Refreshes
from kinetix_dist.runtime.driver.roles import Curator, Reporter, Trainer
from kinetix_dist.runtime.driver.run_data import RunData
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.stopping import StopFailedError, StoppedError, StopRequested, StopSignals
from kinetix_dist.runtime.driver.totals import (
    DESCRIPTION,
    PhysicsWatch,
    RoleClock,
    SessionTotals,
    SkippedUpdates,
    is_over,
    seconds_left,
    totals_before,
)
from kinetix_dist.runtime.processes.failures import Loss, Losses, WorkerLostError
from kinetix_dist.runtime.processes.provenance import versions, what_differs
from kinetix_dist.telemetry.sinks import RANDOM_POLICY

if TYPE_CHECKING:
    from kinetix_dist.runtime.driver.resizing import Resizing

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Roles:
    """Roles that a controller drives."""

    trainer: Trainer
    curator: Curator | None = None
    evaluations: Evaluations | None = None  # during training, in the background; None: the trainer makes them
    resizing: Resizing | None = None  # None: the run keeps its number of processes


class Controller:
    """Drives one run in one run directory."""

    def __init__(
        self,
        config: TrainConfig,
        run: RunDirectory,
        roles: Roles,
        reporter: Reporter,
        *,
        on_rollouts: Callable[[list[Any]], None] = lambda rollouts: None,
        stop: StopSignals | None = None,
        began: float | None = None,
    ) -> None:
        """began: the session, by time.monotonic; None: now."""
        self._data = RunData(config, run, reporter)
        self.config = config
        self.run = run
        self.trainer = roles.trainer
        self._curator = roles.curator
        self.reporter = reporter
        self.clock = RoleClock()
        self.stop = stop or StopSignals()
        self.num_updates = 0
        self.seconds_before = 0.0  # training time of earlier sessions
        self._before = SessionTotals()
        self._began = time.monotonic() if began is None else began
        self._warmup_before = 0.0  # s of it, see `warmup_seconds`
        self._warmup: float | None = None  # s of this session; None: its first update is not done
        self.training_seconds_at_end = 0.0
        self._is_restored = False  # from a checkpoint of this run
        self._is_good = False  # the last evaluation during training reached `run.stop_at`
        self.backend = roles.trainer.backend
        self._on_rollouts = on_rollouts
        self._refreshes = Refreshes(config, self._data, roles.trainer, roles.curator, clock=self.clock, stop=self.stop)
        self._physics = PhysicsWatch()
        self._losses = Losses(
            limit=config.run.max_restarts, on_event=run.event, on_note=reporter.note, on_log=run.try_write_log
        )
        self.backend.losses = self._losses
        self._section = self.backend.sections.section
        self.backend.sections.limits = dataclasses.asdict(config.run.limits)
        self._evaluations = roles.evaluations or InlineEvaluations(config, self._evaluate, self._record)
        self._resizing = roles.resizing
        self._lost: list[Loss] = []  # since the last new result
        self._update_seconds = 0.0  # of the last update
        self._saver = Saver(run, reporter, keep=config.run.keep_checkpoints)
        self._topology: dict[str, Any] = {}
        self._lineage: Sequence[Mapping[str, Any]] = ()
        self._skipped = SkippedUpdates(limit=config.run.max_skipped_updates)
        self._schedule = config.schedule

    def restore(self, *, resume: bool) -> None:
        """Starts the trainer: from the newest good checkpoint if the run goes on, else afresh.

        Raises CheckpointError where the run has checkpoints and none can be used.
        """
        if drafts := remove_dead_drafts(self.run.checkpoints):
            self.run.event("drafts_removed", drafts=drafts)
        checkpoint = newest_checkpoint(self.run, self.config, self.reporter) if resume else None
        self._is_restored = checkpoint is not None
        if checkpoint is not None:
            self.seconds_before = checkpoint.description["training_seconds"]
            self._warmup_before = checkpoint.description.get("warmup_seconds", 0.0)  # earlier versions did not count it
            self._before = totals_before(self.run.report_path, checkpoint.description)
            self.clock.add_earlier(self._before.seconds_by_role)
            self._physics.add_earlier(self._before.physics)
        try:
            with self._section("start"):
                self._start_from(checkpoint)
        except WorkerLostError as error:
            self._recover(error)

    def train(self) -> None:
        """Updates until the configured end; saves a checkpoint there, unless `run.only_updates`.

        Raises StoppedError at the end of an update in which a stop was requested, after a checkpoint is saved, and
        NotFiniteError where nothing can be learned.
        """
        if self.config.run.imitation_steps and not self._is_restored:
            self._imitate(self.config.run.imitation_steps)
        if not self._is_over():
            self.reporter.phase("compiling")
        self.clock.start()
        while not self._is_over():
            self._step()
        self._skipped.check_end()
        self._refreshes.end(self.num_updates)
        self._data.trained(self.num_updates)
        self.training_seconds_at_end = self.training_seconds
        if not self.config.run.only_updates:
            with self.stop.deferred():
                self.save_now()

    def evaluate(self, phase: str) -> dict[str, dict[str, float]]:
        """Solve rates by level set. phase: what evaluations.jsonl calls it; "random_policy" plays random actions."""
        rates = self._repeated(lambda: self._evaluate(use_policy=phase != RANDOM_POLICY))
        self._data.evaluated(phase, self.num_updates, rates, reported_at=self.num_updates)
        return summaries(rates)

    def record(self, num_rollouts: int) -> None:
        """Records rollouts of the current policy and hands them to `on_rollouts`."""
        self._repeated(lambda: self._record(num_rollouts))

    def facts(self) -> dict[str, Any]:
        """Facts of the processes, for the report."""
        return self._repeated(self._facts)

    @property
    def env_steps(self) -> int:
        return self._schedule.env_steps(self.num_updates)

    @property
    def training_seconds(self) -> float:
        return self.seconds_before + self.clock.elapsed

    @property
    def warmup_seconds(self) -> float:
        """Part of the training time before the first update of each session was done: programs are compiled in it."""
        return self._warmup_before + (self.clock.elapsed if self._warmup is None else self._warmup)

    @property
    def wall_seconds(self) -> float:
        """Wall time of all sessions, from the start of each to its last checkpoint or report."""
        return self._before.wall_seconds + time.monotonic() - self._began

    @property
    def lineage(self) -> list[Mapping[str, Any]]:
        """Checkpoints that the run comes from, the oldest first."""
        return list(self._lineage)

    @property
    def physics(self) -> dict[str, int]:
        """Physics steps of all sessions and what was counted in them."""
        return self._physics.totals

    # One update, and whatever else talks to other processes

    def _step(self) -> None:
        """One update, or the way back from what happened in it."""
        try:
            with self.stop.deferred():
                self._one_update()
        except WorkerLostError as error:
            self._recover(error)
        except StopRequested:
            pass  # while waiting for the curator, with the last update complete
        else:
            self._grow()
        if self.stop.requested is not None:
            self._stop()
        if self._skipped.must_go_back(self.num_updates):
            self._go_back()

    def _repeated(self, work: Callable[[], T]) -> T:
        """`work` at the update that is reached: after a loss in it, once that update is reached again."""
        reached = self.num_updates
        while True:
            try:
                while self.num_updates < reached:
                    self._step()
                result = work()
                self._note_recovery()
                return result
            except WorkerLostError as error:
                self._recover(error)

    def _evaluate(self, *, use_policy: bool) -> dict[str, dict[str, Any]]:
        with self._section("evaluate"), self.clock.role("evaluate"):
            return self.trainer.evaluate(use_policy=use_policy)

    def _record(self, num_rollouts: int) -> None:
        with self._section("record"), self.clock.role("record"):
            rollouts = self.trainer.record(num_rollouts, self.num_updates)
            self._on_rollouts(rollouts)

    def _facts(self) -> dict[str, Any]:
        with self._section("report"):
            facts = self.trainer.facts()
            facts["processes"] += self._curator.facts() if self._curator is not None else []
            return facts

    def _one_update(self) -> None:
        self._losses.update = self.num_updates
        self._begin_phase()
        self._refreshes.curate(self.num_updates, update_seconds=self._update_seconds)
        if not self.trainer.policy_lag:  # else a batch drawn ahead is drawn again by a run that goes on
            self.stop.raise_if_requested()  # the update may compile for minutes
        began = time.monotonic()
        with self._section("update"):
            metrics, seconds, attempts = self.trainer.run_update(self.num_updates)
        self._update_seconds = time.monotonic() - began
        self.clock.add(seconds)
        buffer = self._refreshes.buffer_of(self.config.rollout.last_reset(self.num_updates))
        self._data.played(self.num_updates + 1, attempts, num_attempts=metrics["train/attempts"], buffer=buffer)
        self.num_updates += 1
        if self._warmup is None:
            self._warmup = self.clock.elapsed
        self._losses.update = self.num_updates
        self._note_recovery()
        self.reporter.phase("training")
        if self.stop.requested is not None:
            self._report(metrics)  # there is no time for more: evaluations and recordings in between are left out
            return
        seconds = self.training_seconds - self.warmup_seconds
        evaluations = self._evaluations.after_update(self.num_updates, seconds, self.clock, is_last=self._is_over())
        for evaluated in evaluations:
            metrics |= evaluation_metrics(evaluated.rates, evaluated.update)
        self._report(metrics)  # before the checkpoint: a run that is resumed there has the row already
        for evaluated in evaluations:
            self._report_evaluation(evaluated)
        # What the updates that are skipped began from is what to go back to.
        may_save = self._skipped.in_a_row == 0 and not self.config.run.only_updates
        if may_save and _is_due(self.config.run.checkpoint_every, self.num_updates) and not self._is_over():
            self._curate_early()
            self._save()

    def _curate_early(self) -> None:
        """Before a checkpoint what the curriculum does before the next update, so that a run that is resumed there need
        not do it before its first one."""
        if self._refreshes.may_be_early(self.num_updates) and not self._is_over():
            self._refreshes.curate(self.num_updates, update_seconds=self._update_seconds)

    def _begin_phase(self) -> None:
        """Begins a phase where this update, or the batch played meanwhile, is its first: programs are compiled."""
        if self._schedule.beginning(self.num_updates + self.trainer.policy_lag) is not None:
            self.backend.sections.reset()
        phase = self._schedule.beginning(self.num_updates)
        if phase is None:
            return
        self.backend.sections.reset()
        about = {"phase": phase.number, "update": self.num_updates, "env_steps": self.env_steps}
        self.run.event("phase_began", **about, changed=phase.changed)
        changes = ", ".join(f"{name} {value}" for name, value in phase.changed.items())
        self.reporter.note(
            f"phase {phase.number} begins after {self.num_updates} updates, {self.env_steps:,} env steps: {changes}; "
            "what it changes is compiled now (runtime/compile_seconds)"
        )

    def _imitate(self, steps: int) -> None:
        """Imitates proofs or a data set, and evaluates and saves what came of it: that may be good enough to end the
        run.

        Not training time: it depends on `run.imitation_steps` alone. A run that is resumed before its first checkpoint
        does it again, to the same bits.
        """
        assert isinstance(self.trainer, ColocatedTrainer)  # `checks.check_imitation`: placement local
        self.reporter.phase("imitating")
        began = time.monotonic()
        with self._section("update"):
            imitated, about = self.trainer.imitate(steps)
        seconds = round(time.monotonic() - began, 3)
        fields = {"steps": imitated.steps, "seconds": seconds, "loss": round(imitated.loss, 4), **about}
        self.run.event("imitated", **fields, curve=imitated.curve)
        self.reporter.note(_in_words(fields, imitated.curve))
        if self.config.run.only_updates:
            return
        began = time.monotonic()
        rates = self._evaluate(use_policy=True)
        self._report_evaluation(Evaluated(update=0, rates=rates, seconds=time.monotonic() - began))
        if not self._is_over():  # what follows may be killed
            self._save()

    def _report_evaluation(self, evaluated: Evaluated) -> None:
        update, rates = evaluated.update, evaluated.rates
        self._data.evaluated("training", update, rates, reported_at=self.num_updates)
        seconds = round(evaluated.seconds, 3)
        self.run.event("evaluated", update=update, seconds=seconds, solve_rate=summaries(rates))
        stop_at = self.config.run.stop_at
        self._is_good = bool(stop_at) and all(rate["rate"] >= stop_at for rate in rates.values())

    def _report(self, metrics: dict[str, float]) -> None:
        self._saver.collect()
        phase = self._schedule.at(self.num_updates - 1)
        num_steps = phase.config.ppo.epochs * phase.config.ppo.minibatches
        self._watch_skipped(metrics["learner/skipped_steps"], num_steps=num_steps)
        span, shares = self.clock.lap()
        steps_per_update = phase.config.rollout.steps_per_update
        metrics = metrics | {
            "progress/updates": self.num_updates,
            "progress/env_steps": self.env_steps,
            "progress/seconds": self.training_seconds,
            "progress/warmup_seconds": self.warmup_seconds,
            **({"progress/phase": float(phase.number)} if self.config.phases else {}),
            "progress/env_steps_per_second": steps_per_update / max(span, 1e-9),
            "runtime/dropped_steps": self.trainer.dropped_steps,
            **self._losses.metrics(),
            **self._refreshes.metrics(self.num_updates - 1),
            **self.backend.measures(),
            **self._data.metrics(self.num_updates),
            "learner/skipped_updates": self._skipped.num_skipped,
            **{f"time/{role}": share for role, share in shares.items()},
        }
        if self._saver.seconds is not None:
            metrics["runtime/save_seconds"] = self._saver.seconds
        left = seconds_left(self.config.run, env_steps=self.env_steps, training_seconds=self._counted_seconds)
        self._data.processes(self.num_updates, self.backend.processes())
        self.reporter.metrics(self.num_updates, metrics, left)
        physics_steps = steps_per_update * phase.config.env.frame_skip
        for kind, count, warning in self._physics.add(metrics, physics_steps):
            self.run.event("physics_warning", counter=kind, count=count, update=self.num_updates)
            self.reporter.note(warning)

    def _watch_skipped(self, skipped_steps: float, *, num_steps: int) -> None:
        if self._skipped.is_new_kind(skipped_steps, num_steps=num_steps):
            self.run.event("steps_skipped", update=self.num_updates, steps=int(skipped_steps))
        if self._skipped.add(skipped_steps, num_steps=num_steps):
            self.run.event("update_skipped", update=self.num_updates, in_a_row=self._skipped.in_a_row)
            if self._skipped.in_a_row == 1:
                self.reporter.note(f"update {self.num_updates} was skipped: no gradient was finite")

    def _go_back(self) -> None:
        """Goes back to the last checkpoint, after too many updates were skipped in a row."""
        left_at = self.num_updates
        try:
            with self._section("recover"):
                self._restart()
        except WorkerLostError as error:
            self._recover(error)
        self.run.event("rolled_back", from_update=left_at, to_update=self.num_updates)
        self.reporter.note(f"the updates before {left_at} were skipped: back to the checkpoint of {self.num_updates}")

    def _is_over(self) -> bool:
        return self._is_good or is_over(
            self.config.run, env_steps=self.env_steps, training_seconds=self._counted_seconds
        )

    @property
    def _counted_seconds(self) -> float:
        """Training time that `run.max_seconds` limits."""
        return self.training_seconds - (0.0 if self.config.run.warmup_counts else self.warmup_seconds)

    # Checkpoints and recovery

    def _save(self) -> None:
        """Begins a save of this update. A failed one is an event: the older checkpoints are still there."""
        with self._section("save"), self.clock.role("checkpoint"):
            trained = self.trainer.snapshot()
            self._data.saved(self.num_updates, trained)
            arrays = trained | self._refreshes.in_flight() | self._evaluations.in_flight() | self._data.in_flight()
            description = {
                "config": to_dict(self.config),
                "config_hash": self.config.hash,
                "env_steps": self.env_steps,
                "training_seconds": self.training_seconds,
                "warmup_seconds": self.warmup_seconds,
                DESCRIPTION: dataclasses.asdict(
                    SessionTotals(self.wall_seconds, dict(self.clock.totals), self._physics.totals)
                ),
                **self._refreshes.description(),
                **self._evaluations.description(),
                **self._data.description(),
                "versions": versions(),
                "topology": self._topology,
                LINEAGE: self._lineage,
            }
            self._saver.save(self.num_updates, arrays, description)

    def save_now(self) -> bool:
        """Saves this update unless that is done, and waits for it; whether there is such a checkpoint now."""
        with self.clock.role("checkpoint"):
            self._saver.wait()
        if self._saver.saved_at != self.num_updates:
            self._repeated(self._save)
            with self.clock.role("checkpoint"):
                self._saver.wait()
        return self._saver.saved_at == self.num_updates

    def _stop_without_saving(self, error: WorkerLostError) -> None:
        self.run.event("stopped", signal=self.stop.requested, update=self.num_updates, saved=False)
        raise StoppedError(
            f"stopped by {self.stop.requested} in the update after {self.num_updates}, which was lost ({error})"
        ) from error

    def _stop(self) -> None:
        """Saves the last update and ends the run. Before the first one there is nothing to save."""
        with self.stop.deferred():
            if self.num_updates > 0:
                self._repeated(self._curate_early)
            is_saved = self.num_updates > 0 and self.save_now()
        self.run.event("stopped", signal=self.stop.requested, update=self.num_updates, saved=is_saved)
        if self.num_updates > 0 and not is_saved:
            raise StopFailedError(
                f"stopped by {self.stop.requested} after update {self.num_updates}, which could not be saved "
                f"({self.save_error}); go on from the checkpoint before it"
            )
        what = f"after update {self.num_updates}, which is saved" if is_saved else "before the first update"
        self.stop.reached = what
        raise StoppedError(f"stopped by {self.stop.requested} {what}")

    @property
    def save_error(self) -> str | None:
        """Why the last save failed; None where it did not."""
        return self._saver.error

    def close(self) -> None:
        """Lets what is being written come to its end."""
        self._saver.close()
        self._data.close(self.num_updates)

    def _start_from(self, checkpoint: Checkpoint | None) -> None:
        if checkpoint is None:
            self.num_updates = 0
            start = starting_point(self.config)
            self._lineage = start.lineage
            self.trainer.start(0, start.arrays)
            self._topology = self.trainer.topology()
            self._data.start({}, {}, num_updates=0)
            self._refreshes.start({}, {})
            self._evaluations.start({}, {})
            self._refreshes.request_first()
            return
        description = checkpoint.description
        self.num_updates = self._saver.saved_at = description["num_updates"]
        self._lineage = description.get(LINEAGE, ())
        self.trainer.start(self.num_updates, checkpoint.arrays)
        self._topology = self.trainer.topology()
        differs = what_differs(description, self._topology)
        self.run.event("resumed", update=self.num_updates, differs=differs)
        if differs:
            self.reporter.note(f"resumed with {', '.join(differs)}: works, but is not bit for bit the unbroken run")
        self._data.start(description, checkpoint.arrays, num_updates=self.num_updates)
        self._refreshes.start(description, checkpoint.arrays)
        self._evaluations.start(description, checkpoint.arrays)

    def _recover(self, error: WorkerLostError) -> None:
        """Goes back to the newest good checkpoint; a loss on the way is one more. Raises TooManyLossesError."""
        while True:
            if self.stop.requested is not None:  # a signal to all processes of a terminal or a job, say
                self._stop_without_saving(error)
            self._losses.update = self.num_updates
            self._lost.append(self._losses.lost(error))
            try:
                if self._resizing is not None:
                    self._resizing.fit(self.num_updates, self.stop)
                with self._section("recover"):
                    self._restart()
                return
            except WorkerLostError as again:
                error = again

    def _grow(self) -> None:
        """Gives the run more processes where nodes came back and this update is saved: nothing has to be done again."""
        is_saved = _is_due(self.config.run.checkpoint_every, self.num_updates)
        if self._resizing is None or not is_saved or not self._resizing.can_grow():
            return
        self._saver.wait()
        if self._saver.saved_at != self.num_updates:
            return
        try:
            self._resizing.place(self.num_updates, self.stop)
            with self._section("recover"):
                self._restart()
        except WorkerLostError as error:
            self._recover(error)

    def _note_recovery(self) -> None:
        for loss in self._lost:
            self._losses.recovered(loss, update=self.num_updates)
        self._lost = []

    def _restart(self) -> None:
        """Everything from the newest good checkpoint."""
        self.backend.sections.reset()
        self._refreshes.cancel()
        self._saver.wait()
        self._start_from(newest_checkpoint(self.run, self.config, self.reporter))


def _is_due(every: int, num_updates: int) -> bool:
    return every > 0 and num_updates % every == 0


def _in_words(imitated: Mapping[str, Any], curve: Sequence[Mapping[str, float]]) -> str:
    text = f"imitated: {imitated['steps']:,} gradient steps, {imitated['seconds']:.0f} s, loss {imitated['loss']:.3f}"
    best = max(curve, key=lambda point: point["accuracy"], default=None)
    return text if best is None else f"{text}; on levels held out {best['accuracy']:.1%} of actions are alike"
