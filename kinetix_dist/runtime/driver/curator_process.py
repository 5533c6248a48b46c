"""One process that works on refreshes, or on its part of each: asked, watched, and replaced where it was lost.

What was lost with it is asked for again with the same weights and key and gives the identical answer, later.

bound         one call at a time: what is asked for while another refresh, given up by now, is worked out comes after
              it, and replaces what was asked for before. Else calls would pile up at a curator that is late.
"""

from __future__ import annotations

from typing import Any

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.cores.build import build_curator
from kinetix_dist.runtime.driver.process_beside import ProcessBeside
from kinetix_dist.runtime.driver.weight_sync import resolve
from kinetix_dist.runtime.processes.backend import Backend, Ticket
from kinetix_dist.runtime.processes.failures import InputLostError, WorkerLostError
from kinetix_dist.runtime.processes.placement import ProcessPlan


class CuratorProcess(ProcessBeside):
    """Part `part` of `num_parts` of every refresh."""

    def __init__(self, config: TrainConfig, backend: Backend, plan: ProcessPlan, *, part: int, num_parts: int) -> None:
        super().__init__(config, backend, plan)
        self._part, self._num_parts = part, num_parts
        # Of the refresh that is wanted: weights, version, levels to play again or None, what it works from or None.
        self._asked: tuple[Ticket, int, Any, Any] | None = None
        self._is_wanted = False  # whether what the process is at is the refresh that is wanted
        self.is_late = False  # it was lost or waited for in vain, and has not answered since

    def request(self, weights: Ticket, policy_version: int, probe: Any, given: Any) -> None:
        """Starts a refresh; does not wait where there is a process to do it."""
        self.cancel()
        self._asked = (weights, policy_version, probe, given)
        if self._call is None:
            self._ask()
        else:
            self._look()

    def watch(self) -> None:
        """Replaces a process that died, without waiting; what it was asked for is asked for again."""
        if self._call is not None:
            self._look()

    def poll(self, patience_s: float | None) -> tuple[Ticket, dict[str, Any]] | None:
        """What was asked for and its stamp, see `CuratorCore.refresh`; None where it is not there yet. Does not wait.

        The process `is_late` where it was lost, or is silent for more than `patience_s`.
        """
        assert self._call is not None
        stamp, refreshed = self._call
        is_ready = self._is_wanted and stamp.is_ready()
        silence = self._look()
        if is_ready and silence is not None:
            return refreshed, self._taken(stamp)
        if patience_s is not None and (silence is None or silence > patience_s):
            self.is_late = True
        return None

    def cancel(self) -> None:
        """What was asked for is not wanted any more."""
        self._asked, self._is_wanted = None, False

    def facts(self) -> list[dict[str, Any]]:
        """Of its process; that it was lost is a fact too, since training does not depend on it."""
        if self._handle is None or not self._backend.works_beside:
            return []
        try:
            return self._backend.facts([self._handle])
        except WorkerLostError as error:
            return [{"process": self._plan.name, "lost": str(error)}]

    def _look(self) -> float | None:
        """For how long (s) the process has been silent; None where it is lost, and replaced by now."""
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
            if self._asked is not None:
                self._ask()
        return silence

    def _taken(self, stamp: Ticket) -> dict[str, Any]:
        taken = self._backend.gather([stamp])[0]
        self._prepare()
        self._call = self._asked = None
        self._is_wanted = self.is_late = False
        self._note_recovery()
        return taken

    def _prepare(self) -> None:
        """Has a process that was not asked to play a probe, as none is in the first refresh, compile that while it has
        nothing to do, once. Nobody waits for it, and what fails there fails again where it is waited for."""
        assert self._asked is not None and self._handle is not None
        _, policy_version, probe, _ = self._asked
        takes_probes = self._part == self._num_parts - 1 and self._config.curriculum_log.probe_levels > 0
        if takes_probes and probe is None and self._backend.works_beside:
            self._handle.call("prepare", policy_version + self._config.curriculum.refresh_every)

    def _ask(self) -> None:
        assert self._asked is not None
        weights, policy_version, probe, given = self._asked
        part = (self._part, self._num_parts)
        self._call = self._started(build_curator).call_stamped("refresh", weights, policy_version, *part, probe, given)
        self._is_wanted = True

    def _replace(self, error: WorkerLostError) -> None:
        """Starts another process and asks again, without waiting for either."""
        error.process, error.section = self._plan.name, "curate"
        if self._backend.has_lost_room:  # it went with its node: the whole run is placed again
            self.stop()
            raise error
        self._losses.append(self._backend.losses.lost(error))
        self.is_late = True
        self.stop()
        if self._asked is None:  # the next request starts it
            return
        weights, policy_version, *others = self._asked
        put, again = self._backend.put, [resolve(other) for other in others]
        # Their first copies may be gone.
        probe, given = (None if other is None else put(other) for other in again)
        self._asked = put(resolve(weights)), policy_version, probe, given
        self._backend.sections.begin_again()
        self._ask()
