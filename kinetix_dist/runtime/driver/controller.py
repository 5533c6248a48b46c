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
| controller | metrics of an update | orders | the trainer; the curator when a buffer is due | an answer or a death |
| trainer | weights, buffer | the next weights | its workers (colocated) or whole batches (split) | the slowest worker |
| curator | weights of version k, key k | a buffer | nothing | - |

The controller is the same for all placements: it drives a `Trainer` and a `Curator`, which are plain objects in local
mode and Ray actors behind a handle otherwise. It holds no state that is not in the last checkpoint, so a lost worker,
a lost curator and a lost driver are all the same case: restore, re-issue what was in flight, go on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import Checkpoint, flatten_arrays, remove_dead_drafts, select_arrays
from kinetix_dist.config import TrainConfig, to_dict
from kinetix_dist.runtime.driver.clock import RoleClock
from kinetix_dist.runtime.driver.physics_watch import PhysicsWatch
from kinetix_dist.runtime.driver.provenance import versions, what_differs
from kinetix_dist.runtime.driver.resumable import newest_checkpoint
from kinetix_dist.runtime.driver.roles import Curator, Reporter, Trainer
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.saving import Saver
from kinetix_dist.runtime.driver.skipped_updates import SkippedUpdates
from kinetix_dist.runtime.driver.stopping import StopFailedError, StoppedError, StopRequested, StopSignals
from kinetix_dist.runtime.driver.weight_sync import nested, resolve
from kinetix_dist.runtime.processes.failures import WorkerLostError

PENDING = "pending"  # arrays of a checkpoint: weights of the refresh that was in flight


class Controller:
    """Drives one run in one run directory."""

    def __init__(
        self,
        config: TrainConfig,
        run: RunDirectory,
        trainer: Trainer,
        curator: Curator | None,
        reporter: Reporter,
        *,
        on_rollouts: Callable[[list[Any]], None] = lambda rollouts: None,
        stop: StopSignals | None = None,
    ) -> None:
        self.config = config
        self.run = run
        self.trainer = trainer
        self.curator = curator
        self.reporter = reporter
        self.clock = RoleClock()
        self.stop = stop or StopSignals()
        self.num_updates = 0
        self.seconds_before = 0.0  # training time of earlier sessions
        self.training_seconds_at_end = 0.0
        self.num_restarts = 0
        self._on_rollouts = on_rollouts
        self._pending: tuple[int, Any] | None = None  # refresh in flight: policy version, weights
        self._is_stale = False
        self._scoring_seconds: float | None = None  # of the buffer in use
        self._physics = PhysicsWatch()
        self._recovery_seconds = 0.0
        self._saver = Saver(run, reporter, keep=config.run.keep_checkpoints)
        self._topology: dict[str, Any] = {}
        self._skipped = SkippedUpdates(
            steps_per_update=config.ppo.epochs * config.ppo.minibatches, limit=config.run.max_skipped_updates
        )

    def restore(self, *, resume: bool) -> None:
        """Starts the trainer: from the newest good checkpoint if the run goes on, else afresh.

        Raises CheckpointError where the run has checkpoints and none can be used.
        """
        if drafts := remove_dead_drafts(self.run.checkpoints):
            self.run.event("drafts_removed", drafts=drafts)
        checkpoint = newest_checkpoint(self.run, self.config, self.reporter) if resume else None
        if checkpoint is not None:
            self.seconds_before = checkpoint.description["training_seconds"]
        self._start_from(checkpoint)

    def train(self) -> None:
        """Updates until the configured end; saves a checkpoint there.

        Raises StoppedError at the end of an update in which that was asked for, after a checkpoint is saved, and
        NotFiniteError where nothing can be learned.
        """
        self.reporter.phase("compiling")
        self.clock.start()
        while not self._is_over():
            try:
                with self.stop.deferred():
                    self._one_update()
            except WorkerLostError as error:
                if self.stop.requested is not None:  # a signal to all processes of a terminal or a job, say
                    self._stop_without_saving(error)
                self._recover(error)
            except StopRequested:
                pass  # while waiting for the curator, with the last update complete
            if self.stop.requested is not None:
                self._stop()
            if self._skipped.must_go_back(self.num_updates):
                self._go_back()
        self._skipped.check_end()
        self.training_seconds_at_end = self.training_seconds
        with self.stop.deferred():
            self.save_now()

    def evaluate(self, *, use_policy: bool) -> dict[str, dict[str, float]]:
        """Solve rates by level set."""
        with self.clock.role("evaluate"):
            return self.trainer.evaluate(use_policy=use_policy)

    def record(self, num_rollouts: int) -> None:
        """Hands rollouts of the current policy to whoever writes them."""
        with self.clock.role("record"):
            self._on_rollouts(self.trainer.record(num_rollouts, self.num_updates))

    @property
    def env_steps(self) -> int:
        return self.num_updates * self.config.rollout.steps_per_update

    @property
    def training_seconds(self) -> float:
        return self.seconds_before + self.clock.elapsed

    @property
    def physics(self) -> dict[str, int]:
        """Physics steps of this session and what was counted in them."""
        return self._physics.totals

    # One update

    def _one_update(self) -> None:
        self._curate()
        metrics, seconds = self.trainer.run_update(self.num_updates)
        self.clock.add(seconds)
        self.num_updates += 1
        self.reporter.phase("training")
        if self.stop.requested is not None:
            self._report(metrics)  # there is no time for more: evaluations and recordings in between are left out
            return
        if _is_due(self.config.evaluation.every, self.num_updates):
            metrics |= self._evaluate_metrics()
        if _is_due(self.config.recording.every, self.num_updates):
            self.record(self.config.recording.num_rollouts)
        self._report(metrics)  # before the checkpoint: a run that is resumed there has the row already
        # What the updates that are skipped began from is what to go back to.
        is_well = self._skipped.in_a_row == 0
        if is_well and _is_due(self.config.run.checkpoint_every, self.num_updates) and not self._is_over():
            self._save()

    def _curate(self) -> None:
        """Asks for refreshes and adopts buffers at update indices that are fixed beforehand."""
        if self.curator is None:
            return
        self._adopt_if_due()
        if self.config.curriculum.is_refresh_due(self.num_updates):
            self._request(self.num_updates, self.trainer.weights())
            self._adopt_if_due()

    def _request(self, policy_version: int, weights: Any) -> None:
        assert self.curator is not None
        self._pending = (policy_version, weights)
        with self.clock.role("curate"):
            self.curator.request(weights, policy_version)

    def _adopt_if_due(self) -> None:
        drawn_next = self.num_updates + self.trainer.policy_lag  # the batch whose levels are drawn now
        if self._pending is None or self.config.curriculum.adopted_at(self._pending[0]) > drawn_next:
            return
        assert self.curator is not None
        if self._pending[0] == 0:
            self.reporter.phase("curating")
        with self.clock.role("curate"), self.stop.interruptible():
            refresh = self.curator.take()
        self._is_stale = refresh is None
        if refresh is None:
            self.run.event("refresh_lost", policy_version=self._pending[0], update=self.num_updates)
            self.reporter.note(
                f"the refresh of policy version {self._pending[0]} was lost; the old buffer stays in use"
            )
        else:
            self.trainer.adopt(refresh.refreshed)
            self._scoring_seconds = refresh.seconds
            self.run.event("buffer_adopted", policy_version=self._pending[0], update=drawn_next)
        self._pending = None

    def _evaluate_metrics(self) -> dict[str, float]:
        rates = self.evaluate(use_policy=True)
        return {
            f"evaluation/{name}/{metric}": rate[field]
            for name, rate in rates.items()
            for metric, field in (("solve_rate", "rate"), ("low", "low"), ("high", "high"))
        }

    def _report(self, metrics: dict[str, float]) -> None:
        self._saver.collect()
        self._watch_skipped(metrics["learner/skipped_steps"])
        span, shares = self.clock.lap()
        restarts = self.num_restarts + (self.curator.num_restarts if self.curator is not None else 0)
        metrics = metrics | {
            "progress/updates": self.num_updates,
            "progress/env_steps": self.env_steps,
            "progress/seconds": self.training_seconds,
            "progress/env_steps_per_second": self.config.rollout.steps_per_update / max(span, 1e-9),
            "runtime/dropped_steps": self.trainer.dropped_steps,
            "runtime/restarts": restarts,
            "learner/skipped_updates": self._skipped.num_skipped,
            **{f"time/{role}": share for role, share in shares.items()},
        }
        if self.curator is not None:
            metrics["curriculum/buffer_is_stale"] = float(self._is_stale)
        if self._scoring_seconds is not None:
            metrics["curriculum/scoring_seconds"] = self._scoring_seconds
        if self._saver.seconds is not None:
            metrics["runtime/save_seconds"] = self._saver.seconds
        if self._recovery_seconds:
            metrics["runtime/recovery_seconds"] = self._recovery_seconds
        self.reporter.metrics(self.num_updates, metrics, self._seconds_left())
        physics_steps = self.config.rollout.steps_per_update * self.config.env.frame_skip
        for kind, count, warning in self._physics.add(metrics, physics_steps):
            self.run.event("physics_warning", counter=kind, count=count, update=self.num_updates)
            self.reporter.note(warning)

    def _watch_skipped(self, skipped_steps: float) -> None:
        if self._skipped.is_new_kind(skipped_steps):
            self.run.event("steps_skipped", update=self.num_updates, steps=int(skipped_steps))
        if self._skipped.add(skipped_steps):
            self.run.event("update_skipped", update=self.num_updates, in_a_row=self._skipped.in_a_row)
            if self._skipped.in_a_row == 1:
                self.reporter.note(f"update {self.num_updates} was skipped: no gradient was finite")

    def _go_back(self) -> None:
        """To the last checkpoint, after too many updates were skipped in a row."""
        left_at = self.num_updates
        self._restart()
        self.run.event("rolled_back", from_update=left_at, to_update=self.num_updates)
        self.reporter.note(f"the updates before {left_at} were skipped: back to the checkpoint of {self.num_updates}")

    def _is_over(self) -> bool:
        run = self.config.run
        if run.total_env_steps and self.env_steps >= run.total_env_steps:
            return True
        return bool(run.max_seconds) and self.training_seconds >= run.max_seconds

    def _seconds_left(self) -> float:
        run = self.config.run
        ends = []
        if run.max_seconds:
            ends.append(run.max_seconds - self.training_seconds)
        if run.total_env_steps:
            steps_per_second = self.env_steps / max(self.training_seconds, 1e-9)
            ends.append((run.total_env_steps - self.env_steps) / max(steps_per_second, 1e-9))
        return max(min(ends), 0.0)

    # Checkpoints and recovery

    def _save(self) -> None:
        """Begins a save of this update. A failed one is an event: the older checkpoints are still there."""
        with self.clock.role("checkpoint"):
            arrays = self.trainer.snapshot() | self._in_flight()
            description = {
                "config": to_dict(self.config),
                "config_hash": self.config.hash,
                "env_steps": self.env_steps,
                "training_seconds": self.training_seconds,
                "refresh_in_flight": self._pending[0] if self._pending is not None else None,
                "buffer_is_stale": self._is_stale,
                "scoring_seconds": self._scoring_seconds,
                "versions": versions(),
                "topology": self._topology,
            }
            self._saver.save(self.num_updates, arrays, description)

    def save_now(self) -> bool:
        """Saves this update unless that is done, and waits for it; whether there is such a checkpoint now."""
        with self.clock.role("checkpoint"):
            self._saver.wait()
        if self._saver.saved_at != self.num_updates:
            self._save()
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
            is_saved = self.num_updates > 0 and self.save_now()
        self.run.event("stopped", signal=self.stop.requested, update=self.num_updates, saved=is_saved)
        if self.num_updates > 0 and not is_saved:
            raise StopFailedError(
                f"stopped by {self.stop.requested} after update {self.num_updates}, which could not be saved "
                f"({self.save_error}); go on from the checkpoint before it"
            )
        what = f"after update {self.num_updates}, which is saved" if is_saved else "before the first update"
        raise StoppedError(f"stopped by {self.stop.requested} {what}")

    @property
    def save_error(self) -> str | None:
        """Why the last save failed; None where it did not."""
        return self._saver.error

    def close(self) -> None:
        """Lets a save in flight come to its end."""
        self._saver.close()

    def _in_flight(self) -> dict[str, np.ndarray]:
        if self._pending is None or self.curator is None:
            return {}
        return flatten_arrays({PENDING: resolve(self._pending[1])})

    def _start_from(self, checkpoint: Checkpoint | None) -> None:
        self._pending = None
        if checkpoint is None:
            self.num_updates, self._is_stale, self._scoring_seconds = 0, False, None
            self.trainer.start(0, None)
            self._topology = self.trainer.topology()
            return
        description = checkpoint.description
        self.num_updates = self._saver.saved_at = description["num_updates"]
        self._is_stale = description["buffer_is_stale"]
        self._scoring_seconds = description.get("scoring_seconds")
        self.trainer.start(self.num_updates, checkpoint.arrays)
        self._topology = self.trainer.topology()
        differs = what_differs(description, self._topology)
        self.run.event("resumed", update=self.num_updates, differs=differs)
        if differs:
            self.reporter.note(f"resumed with {', '.join(differs)}: works, but is not bit for bit the unbroken run")
        version = description["refresh_in_flight"]
        if version is not None and self.curator is not None:
            self._request(version, nested(select_arrays(checkpoint.arrays, PENDING)))

    def _recover(self, error: WorkerLostError) -> None:
        """Everything of the trainer is gone by now; goes back to the newest good checkpoint."""
        self.num_restarts += 1
        self.run.event("worker_lost", update=self.num_updates, error=str(error), restart=self.num_restarts)
        self.reporter.note(f"{error}; restart {self.num_restarts} of {self.config.run.max_restarts}")
        if self.num_restarts > self.config.run.max_restarts:
            raise WorkerLostError(f"{error}, once more than run.max_restarts {self.config.run.max_restarts}") from error
        began = time.monotonic()
        lost_at = self.num_updates
        self._restart()
        self._recovery_seconds = time.monotonic() - began
        self.run.event("recovered", from_update=lost_at, to_update=self.num_updates, seconds=self._recovery_seconds)

    def _restart(self) -> None:
        """Everything from the newest good checkpoint."""
        if self.curator is not None:
            self.curator.cancel()
        self._saver.wait()
        self._start_from(newest_checkpoint(self.run, self.config, self.reporter))


def _is_due(every: int, num_updates: int) -> bool:
    return every > 0 and num_updates % every == 0
