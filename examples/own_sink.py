"""A sink of your own: metrics, evaluations and events of a run in Weights & Biases.

    pip install wandb
    python examples/own_sink.py                             trains for seconds on the CPU, W&B offline
    PYTHONPATH=examples WANDB_MODE=online kinetix-dist train --recipe quickstart \\
        --run.plugins own_sink --run.sinks tensorboard wandb

A sink is opened in the process that drives the run and called by a thread of its own: what it raises is an event
(`sink_failing`), what it takes long for costs no time. `wandb sync RUN/wandb/offline-run-*` uploads offline runs.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Mapping
from typing import Any

from kinetix_dist.cli.main import main
from kinetix_dist.telemetry.sinks import SINKS, Evaluation, Sink, SinkRun

STEPS = "progress/env_steps"  # the horizontal axis of every chart


class WandbSink(Sink):
    """A W&B run for each part of a run, in a group of the run's name: W&B cannot take rows back, and parts never do."""

    def __init__(self, run: SinkRun) -> None:
        import wandb

        self._run = wandb.init(
            project="kinetix-dist",
            group=run.name,
            name=f"{run.name} from update {run.resume_at}",
            id=run.id,
            resume="allow",  # after a failure of this sink the same W&B run goes on
            config={**run.config, "config_hash": run.config_hash},
            dir=run.directory,
            settings=wandb.Settings(console="off", quiet=True),  # the terminal is the run's
            mode="online" if os.environ.get("WANDB_MODE") == "online" else "offline",
        )
        self._run.define_metric(STEPS)
        self._run.define_metric("*", step_metric=STEPS)
        self._num_events: Counter[str] = Counter()

    @classmethod
    def prepare(cls) -> None:
        import wandb  # noqa: F401

    def metrics(self, update: int, metrics: Mapping[str, float]) -> None:
        self._run.log(dict(metrics))

    def evaluated(self, evaluation: Evaluation) -> None:
        self._run.log({**evaluation.metrics, STEPS: evaluation.env_steps})

    def event(self, event: Mapping[str, Any]) -> None:
        self._num_events[event["event"]] += 1
        self._run.summary.update({f"events/{name}": count for name, count in self._num_events.items()})

    def close(self) -> None:
        self._run.finish()


if __name__ == "__main__":
    options = ["--run.plugins", "own_sink", "--run.sinks", "tensorboard", "wandb"]
    raise SystemExit(main(["train", "--recipe", "tiny", *options, *sys.argv[1:]]))

# A run imports this file as a plugin, in each of its processes: the name is known from then on.
SINKS.register("wandb", WandbSink)
