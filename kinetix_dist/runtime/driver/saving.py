"""Checkpoints are written beside training: copying off the devices is waited for, writing and verifying is not.

consumes      arrays in host memory
produces      a published checkpoint; older ones are pruned once it is verified
bound         one save at a time: the next one waits for the one before, so that arrays are held twice at most
a failure     is an event and a note at the next update; older checkpoints are untouched, and the next save tries
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax.numpy as jnp
import numpy as np

from kinetix_dist.checkpoint import save_checkpoint
from kinetix_dist.errors import one_line
from kinetix_dist.runtime.cores.stored import LEARNER
from kinetix_dist.runtime.driver.roles import Reporter
from kinetix_dist.runtime.driver.run_directory import RunDirectory


class Saver:
    """Saves the checkpoints of one run. All methods are for the thread that drives the run."""

    def __init__(self, run: RunDirectory, reporter: Reporter, *, keep: int) -> None:
        self._run = run
        self._reporter = reporter
        self._keep = keep
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoint")
        # Update, and of its save the seconds and whether config.json had to be written again.
        self._in_flight: tuple[int, Future[tuple[float, bool]]] | None = None
        self.saved_at: int | None = None  # update of the newest checkpoint of this session, or resumed from
        self.seconds: float | None = None  # that writing and verifying the last one took
        self.error: str | None = None  # why the last save failed; None where it did not

    def save(self, num_updates: int, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> None:
        """Begins a save; waits only for the one before it."""
        self.wait()
        self._in_flight = (num_updates, self._thread.submit(self._write, num_updates, arrays, description))

    def collect(self) -> None:
        """Says what became of a save that is over; does not wait."""
        if self._in_flight is not None and self._in_flight[1].done():
            self.wait()

    def wait(self) -> None:
        """Until nothing is being saved. `saved_at` says how that went."""
        if self._in_flight is None:
            return
        (num_updates, future), self._in_flight = self._in_flight, None
        error = future.exception()
        if error is None:
            self.seconds, was_gone = future.result()
            self.saved_at, self.error = num_updates, None
            if was_gone:
                self._run.event("file_failed", file=self._run.config_path.name, error="it was gone; written again")
                self._reporter.note(
                    f"{self._run.config_path} was gone and is written again: is this still the directory of the run? "
                    "Metrics may go on elsewhere"
                )
            self._run.event("checkpoint_saved", update=num_updates, seconds=round(self.seconds, 3))
            return
        # Whatever it is: Orbax has errors of many kinds for a disk that is full. Training goes on from memory.
        self.error = one_line(error)
        self._run.event("checkpoint_failed", update=num_updates, error=self.error)
        self._reporter.note(f"checkpoint at update {num_updates} failed, training goes on: {self.error}")

    def close(self) -> None:
        """Waits for a save in flight, also where the run ends by an error."""
        self.wait()
        self._thread.shutdown()

    def _write(
        self, num_updates: int, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]
    ) -> tuple[float, bool]:
        began = time.monotonic()
        if name := next((name for name in arrays if name.startswith(f"{LEARNER}/") and _has_nan(arrays[name])), None):
            raise ValueError(f"{name} is not finite: nothing could go on from it")
        was_gone = self._run.restore_config()
        save_checkpoint(self._run.checkpoints, num_updates, arrays, description, keep=self._keep)
        return time.monotonic() - began, was_gone


def _has_nan(array: np.ndarray) -> bool:
    return bool(jnp.issubdtype(array.dtype, jnp.floating)) and not bool(np.isfinite(array).all())
