"""One short training run and its numbers, in this process or in one of its own. It alone uses the runtime.

python -m kinetix_dist.benchmarks.training_run FOLDER       reads FOLDER/config.json, writes FOLDER/run.json
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.child_python import command_of
from kinetix_dist.config import TrainConfig, from_dict, to_dict
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.jax_checks import check_arithmetic, check_settings
from kinetix_dist.program_cache import enable_compile_cache
from kinetix_dist.runtime import PlacementError, RunDirectory, count_gpus, plan_placement, resolve_device, train
from kinetix_dist.telemetry.sinks.jsonl import read_jsonl


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingRun:
    """Result of a run: its report and one row of metrics for every update."""

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


MODULE = "kinetix_dist.benchmarks.training_run"
CONFIG, RUN = "config.json", "run.json"


class RunFailedError(Exception):
    """Failure of a process that ended without a run, with its last line."""


def environment_of(placement: str, devices: int, *, on_gpu: bool) -> dict[str, str]:
    """Variables with which a process sees so many devices."""
    if on_gpu:
        visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
        chosen = visible[:devices] if visible else [str(number) for number in range(devices)]
        return {"CUDA_VISIBLE_DEVICES": ",".join(chosen)}
    environment = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    if placement == "local" and devices > 1:
        flags = [os.environ.get("XLA_FLAGS", ""), f"--xla_force_host_platform_device_count={devices}"]
        environment["XLA_FLAGS"] = " ".join(filter(None, flags))
    return environment


def run_in_process(config: TrainConfig, environment: Mapping[str, str], *, timeout_seconds: float) -> TrainingRun:
    """Runs `config` in a new process; `environment` is added to this one's. Raises RunFailedError."""
    with tempfile.TemporaryDirectory(prefix="kinetix-bench-") as name:
        folder = Path(name)
        (folder / CONFIG).write_text(json.dumps(to_dict(config)))
        command = command_of(MODULE, folder)
        process = subprocess.Popen(
            command,
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        try:
            _, said = process.communicate(timeout=timeout_seconds)
        except subprocess.TimeoutExpired:
            process.terminate()  # the run ends its own processes
            try:
                process.communicate(timeout=30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
            raise RunFailedError(f"not done after {timeout_seconds:g} s") from None
        if process.returncode != 0:
            lines = [line for line in said.splitlines() if line.strip()]
            raise RunFailedError(one_line(lines[-1])[:300] if lines else f"exit code {process.returncode}")
        return TrainingRun(**json.loads((folder / RUN).read_text()))


def main(folder: Path) -> int:
    try:
        run = run_training(from_dict(json.loads((folder / CONFIG).read_text())))
    except UserError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    (folder / RUN).write_text(json.dumps(dataclasses.asdict(run)))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
