"""Protocols that the controller drives: a trainer, a curator and a reporter."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from kinetix_dist.runtime.processes.backend import Backend
from kinetix_dist.runtime.processes.placement import Placement
from kinetix_dist.telemetry.sinks import Evaluation


class Trainer(Protocol):
    """Plays and learns."""

    policy_lag: int
    backend: Backend

    @property
    def dropped_steps(self) -> int:
        """Environment steps that were played and never learned from."""
        ...

    def start(self, num_updates: int, arrays: Mapping[str, np.ndarray] | None) -> None:
        """Builds everything at an update boundary: from a checkpoint's arrays, or afresh. Also after a loss."""

    def place(self, placement: Placement) -> None:
        """Other processes from the next start on."""

    def weights(self) -> Any:
        """The parameters for evaluation and scoring now, or a reference to them: what a curator is given."""

    def adopt(self, parts: Sequence[Any]) -> None:
        """Uses what curators worked out, `Refresh.parts`, for every batch drawn from now on."""

    def run_update(self, num_updates: int) -> tuple[dict[str, float], dict[str, float], dict[str, np.ndarray]]:
        """One rollout and one policy update: (metrics, seconds by role, attempts and those solved by
        `Proposal.source`). Raises WorkerLostError."""

    def probe(self, num_levels: int) -> Any:
        """Levels of the buffer in use, or a reference to them, for `Curator.request`."""

    def refresh_input(self) -> Any:
        """Input of a refresh besides the policy, or a reference to it, for `Curator.request`."""

    def check(self) -> None:
        """Raises WorkerLostError where one of its processes is lost while no call waits for it. Does not wait."""

    def snapshot(self) -> dict[str, np.ndarray]:
        """All arrays that `start` needs to go on from here bit for bit."""

    def evaluate(self, *, use_policy: bool) -> dict[str, dict[str, Any]]:
        """Solve rates by level set, as `Evaluator.evaluate` gives them, of the current policy or of random actions."""

    def record(self, num_rollouts: int, num_updates: int) -> list[Any]:
        """Rollouts of the current policy on the evaluation sets (`telemetry.recording.Rollout`)."""

    def topology(self) -> dict[str, Any]:
        """Hardware that computes, for checkpoints: "placement", "processes", and "devices", "platform", "kind" that
        learn."""

    def facts(self) -> dict[str, Any]:
        """Facts for the report: "device" (platform, kind and number of those that learn), "compile_seconds",
        "processes"."""

    def stop(self) -> None: ...


@dataclasses.dataclass(frozen=True)
class Refresh:
    """Refresh of a curriculum, as curators worked it out."""

    parts: Sequence[Any]  # for the curriculum to join and adopt, of each curator: a reference to it
    seconds: float  # that the slowest took
    probe: Mapping[str, np.ndarray]  # what became of levels of the buffer before, see `Curriculum.play_probe`

    @classmethod
    def of(cls, parts: Sequence[Any], headers: Sequence[Mapping[str, Any]]) -> Refresh:
        """headers: of each part, as `CuratorCore.refresh` gives them; the last one's process played the probe."""
        return cls(parts=parts, seconds=max(header["seconds"] for header in headers), probe=headers[-1]["probe"])


class Curator(Protocol):
    """Refreshes the curriculum: processes in the background, each with a part of it, or those that train."""

    @property
    def works_in_background(self) -> bool:
        """True if it works while training continues."""
        ...

    def request(self, weights: Any, policy_version: int, probe: Any, given: Any) -> None:
        """Requests a refresh and does not wait: processes in the background begin now, those that train when it is
        taken. probe, given: of `Trainer.probe` and `Trainer.refresh_input`, or None."""

    def watch(self) -> None:
        """Replaces processes in the background that died, without waiting; their parts are requested again."""

    def take(self, *, patience_s: float | None, meanwhile: Callable[[], None] = lambda: None) -> Refresh | None:
        """Waits for the refresh that was requested last. None where a process was lost, or is silent for `patience_s`.

        patience_s: None: waits as long as it takes, over losses too. meanwhile: called again and again; an error that
        it raises ends the wait.
        """

    def cancel(self) -> None: ...

    def facts(self) -> list[dict[str, Any]]:
        """Facts of its processes for the report; none where it shares that of the trainer."""

    def stop(self) -> None: ...


class Reporter(Protocol):
    """Destination of progress: console and metric files."""

    def phase(self, name: str) -> None: ...

    def note(self, message: str) -> None: ...

    def metrics(self, num_updates: int, metrics: Mapping[str, float], seconds_left: float | None) -> None: ...

    def evaluated(self, evaluation: Evaluation) -> None:
        """An evaluation has come; during training after the metrics of the update at which it came."""
