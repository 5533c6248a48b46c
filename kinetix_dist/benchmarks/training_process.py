"""A training run in a process of its own, which sees the devices that it is given and no others.

python -m kinetix_dist.benchmarks.training_process FOLDER       reads FOLDER/config.json, writes FOLDER/run.json
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

from kinetix_dist.benchmarks.training_run import TrainingRun, run_training
from kinetix_dist.child_python import command_of
from kinetix_dist.config import TrainConfig, from_dict, to_dict
from kinetix_dist.errors import UserError, one_line

MODULE = "kinetix_dist.benchmarks.training_process"
CONFIG, RUN = "config.json", "run.json"


class RunFailedError(Exception):
    """The process ended without a run, with its last words."""


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
