"""Interface of a sink: where the metrics, evaluations and events of a run go, besides the files of its directory.

A new sink is one file with a `Sink` and its registration: docs/extending.md.

    driver --metrics(row)--> [queue, bounded] --> thread of the sink --> files, or a service

Every sink has a thread of its own (background.py), in the process that drives the run: what it raises is reported as
`sink_failing`, and the sink is opened again with the next row; what it takes long for costs training no time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from kinetix_dist.registry import Registry

RANDOM_POLICY = "random_policy"  # a phase of evaluations


@dataclasses.dataclass(frozen=True, kw_only=True)
class SinkRun:
    """Part of a run that a sink is opened for: from its start, or from where it went back to, up to the next such time.

    A run that is resumed, or that goes back to a checkpoint after a loss, reports later rows again: the sink is closed,
    and opened for another part.
    """

    name: str  # of the run directory
    directory: Path
    config: Mapping[str, Any]  # every setting, by section, as in config.json
    config_hash: str
    session: int  # 1, and 1 more with every --resume
    resume_at: int  # updates that are done: rows of later ones, of parts before this one, are repeated in this part
    from_env_steps: int  # environment steps from which on points of earlier parts are repeated
    began_at: float  # s since the epoch
    id: str  # of this part, letters that every service takes: the same where a sink is opened again after a failure


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Solve rates of all evaluation sets, of the policy after some update."""

    phase: str  # "random_policy" and "before" (update 0), "training", "after" (the last update)
    update: int  # done by the policy that was evaluated
    env_steps: int  # at that update
    reported_at: int  # updates done when the result came
    rates: Mapping[str, Mapping[str, Any]]  # {set: {"rate", "low", "high": share, "attempts": int, ...}}

    @property
    def metrics(self) -> dict[str, float]:
        """By their names in `telemetry.names`; random actions have a name of their own."""
        if self.phase == RANDOM_POLICY:
            return {f"evaluation/{name}/random_actions": float(rate["rate"]) for name, rate in self.rates.items()}
        return evaluation_rates(self.rates)


def evaluation_rates(rates: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Metrics of an evaluation of a policy: rate and 95 % interval of each set."""
    return {
        f"evaluation/{name}/{metric}": float(rate[field])
        for name, rate in rates.items()
        for metric, field in (("solve_rate", "rate"), ("low", "low"), ("high", "high"))
    }


class Sink:
    """A sink of one part of a run. A method that is not overridden leaves out what it is given.

    All methods are called by one thread. Any of them may raise: that row is dropped and counted.
    """

    patience_s: ClassVar[float] = 0.0  # that training waits for a row to be written, at most

    def __init__(self, run: SinkRun) -> None:
        """Opens it, before the first row."""

    @classmethod
    def prepare(cls) -> None:
        """Imports what takes long, while the start of the run waits for other processes."""

    def metrics(self, update: int, metrics: Mapping[str, float]) -> None:
        """Takes the metrics of the update that led to `update`, by their names in `telemetry.names`, among them
        "progress/env_steps". A number may be nan or inf."""

    def evaluated(self, evaluation: Evaluation) -> None:
        """Takes an evaluation. That of an update may come after the metrics of later ones."""

    def event(self, event: Mapping[str, Any]) -> None:
        """Takes an event as events.jsonl has it: "time", "event" (a name of docs/operating.md), details."""

    def close(self) -> None:
        """Closes it: at the end of the part, or after a failure."""


SINKS: Registry[type[Sink]] = Registry("sink")
