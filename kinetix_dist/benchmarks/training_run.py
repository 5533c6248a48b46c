"""One short training run and its numbers, in this process or in its own. No other benchmark uses the runtime.

python -m kinetix_dist.benchmarks.training_run FOLDER       reads FOLDER/config.json, writes FOLDER/run.json
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.child_python import command_of
from kinetix_dist.config import TrainConfig, from_dict, to_dict
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.json_text import json_text
from kinetix_dist.runtime import (
    PlacementError,
    RunDirectory,
    StoppedError,
    count_gpus,
    plan_placement,
    resolve_device,
    train,
)
from kinetix_dist.runtime import RunFailedError as TrainingFailedError
from kinetix_dist.telemetry.sinks.console import Progress
from kinetix_dist.telemetry.sinks.jsonl import read_jsonl


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingRun:
    """Result of a run: its report and one row of metrics for every update."""

    report: dict[str, Any]
    rows: list[dict[str, Any]]


class RunFailedError(Exception):
    """A run that ended before its end, or its process, with the reason."""


class UpdateLines:
    """`Progress` of a measured run: a line for each step and each update."""

    def __init__(self, report: Callable[[str], None], *, num_updates: int, num_warm: int) -> None:
        """Take the receiver of the lines, the updates of the run, and how many of them are not measured."""
        self._report = report
        self._num_updates = num_updates
        self._num_warm = num_warm

    def set_phase(self, phase: str) -> None:
        if phase == "compiling":
            self._report("  compiling: the first update compiles, and is not measured")

    def set_seconds_left(self, seconds: float | None) -> None:
        """Every update has its line."""

    def note(self, message: str) -> None:
        self._report(f"  {message}")

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        speed = f"{metrics['progress/env_steps_per_second']:,.0f} env steps/s"
        if update == 1:
            speed = f"{metrics['progress/seconds']:.1f} s"
        is_measured = update > self._num_warm
        self._report(f"  update {update} of {self._num_updates}: {speed}{'' if is_measured else ', not measured'}")
        if update == self._num_warm:
            self._report(f"  measuring {self._num_updates - self._num_warm} updates")

    def close(self) -> None:
        """Lines are complete."""


def run_training(config: TrainConfig, progress: Progress | None = None) -> TrainingRun:
    """Run `config` from its start to its end in a directory that is removed afterwards.

    Args:
        config: The run.
        progress: Shows it; None for the console of `kinetix-dist train`.

    Raises:
        UserError: The run cannot start on this machine.
        RunFailedError: A process of the run failed.
        KeyboardInterrupt: A signal stopped the run.
    """
    with tempfile.TemporaryDirectory(prefix="kinetix-bench-") as folder:
        run = RunDirectory.create(Path(folder) / "run", numbered=False)
        try:
            with user_errors(CheckpointError, PlacementError, FileNotFoundError):
                report = train(config, run, resume=False, console=progress)
            return TrainingRun(report=report, rows=list(read_jsonl(run.metrics / "metrics.jsonl")))
        except TrainingFailedError as error:
            raise RunFailedError(one_line(error)) from error
        except StoppedError as error:
            raise KeyboardInterrupt from error
        finally:
            run.close()


def number_of_gpus(device: str) -> int:
    """Return the number of GPUs that a run with `run.device` uses. Raise UserError if it lacks the one it needs."""
    num_gpus = count_gpus()
    with user_errors(PlacementError):
        return num_gpus if resolve_device(device, num_gpus=num_gpus) == "gpu" else 0


def check_placement(config: TrainConfig, num_gpus: int) -> None:
    """Raise ValueError if the roles of `config` do not fit on `num_gpus` GPUs."""
    resolve_device(config.run.device, num_gpus=num_gpus)
    if config.run.placement != "local":
        plan_placement(config, num_gpus=num_gpus)


MODULE = "kinetix_dist.benchmarks.training_run"
CONFIG, RUN = "config.json", "run.json"


def environment_of(placement: str, devices: int, *, on_gpu: bool) -> dict[str, str]:
    """Return the environment variables that show a process `devices` devices."""
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
        (folder / CONFIG).write_text(json_text(to_dict(config)))
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
    except (UserError, RunFailedError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    (folder / RUN).write_text(json_text(dataclasses.asdict(run)))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
