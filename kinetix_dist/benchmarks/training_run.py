"""One short training run, and the numbers that it left. The only file of the benchmarks that imports the runtime."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import user_errors
from kinetix_dist.jax_arithmetic import check_arithmetic
from kinetix_dist.jax_settings import check_settings
from kinetix_dist.runtime import PlacementError, RunDirectory, count_gpus, plan_placement, resolve_device, train
from kinetix_dist.telemetry.compile_cache import enable_compile_cache
from kinetix_dist.telemetry.sinks.jsonl import read_jsonl


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingRun:
    """What a run leaves: its report and one row of metrics for every update."""

    report: dict[str, Any]
    rows: list[dict[str, Any]]


def run_training(config: TrainConfig) -> TrainingRun:
    """Runs `config` from the start to its end in a directory that is removed afterwards.

    Raises UserError for what cannot run on this machine.
    """
    with tempfile.TemporaryDirectory(prefix="kinetix-bench-") as folder:
        run = RunDirectory.create(Path(folder) / "run", numbered=False)
        try:
            check_settings()
            check_arithmetic()
            enable_compile_cache(config.run.compile_cache)
            with user_errors(CheckpointError, PlacementError, FileNotFoundError):
                report = train(config, run, resume=False)
            return TrainingRun(report=report, rows=list(read_jsonl(run.metrics / "metrics.jsonl")))
        finally:
            run.close()


def number_of_gpus(device: str) -> int:
    """GPUs that a run with `run.device` would use; raises UserError where it needs one and there is none."""
    num_gpus = count_gpus()
    with user_errors(PlacementError):
        return num_gpus if resolve_device(device, num_gpus=num_gpus) == "gpu" else 0


def check_placement(config: TrainConfig, num_gpus: int) -> None:
    """Raises ValueError where the roles of `config` do not fit on so many GPUs."""
    resolve_device(config.run.device, num_gpus=num_gpus)
    if config.run.placement != "local":
        plan_placement(config, num_gpus=num_gpus)
