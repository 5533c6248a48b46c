"""`kinetix-dist train` as a process of its own: starting it, watching its files, ending its parts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kinetix_dist.telemetry.json_lines import read_lines
from tests.helpers import REPOSITORY, python_path

# One level is evaluated, four times: what takes long in a tiny run is left out.
TINY = ["--recipe", "tiny", "--evaluation.sets", "s/kick", "--evaluation.min_attempts", "4"]
STEPS_PER_UPDATE = 128
# Of one GPU for a run, so that other tests can use it at the same time; more than the reserves of two processes.
GPU_MEMORY_GIB = 10
LIMIT_S = 280.0
# A run whose pipe is full waits until it is read, and XLA says 4 kB for each program that another CPU had compiled.
PIPE_BYTES = 1 << 20


def start(run: Path, *options: str, device: str = "cpu", new_session: bool = False) -> subprocess.Popen[str]:
    """Starts training in `run`. On a GPU it computes the same bits every time, at some cost of speed. new_session: as
    a terminal would, in a process group that signals can be sent to."""
    left_out = ("JAX_PLATFORMS", "XLA_") if device == "gpu" else ("JAX_PLATFORMS", "XLA_PYTHON")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(left_out)}
    command = [sys.executable, "-m", "kinetix_dist.cli.main", "train", "--run", str(run), "--run.device", device]
    if device == "gpu":
        environment["XLA_FLAGS"] = "--xla_gpu_deterministic_ops=true"
        command += ["--run.gpu_memory_gib", str(GPU_MEMORY_GIB)]
    else:
        environment["JAX_PLATFORMS"] = "cpu"
    return subprocess.Popen(
        [*command, *options],
        env={**environment, "PYTHONPATH": python_path()},
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        pipesize=PIPE_BYTES,
        text=True,
        start_new_session=new_session,
    )


def finish(process: subprocess.Popen[str], *, limit_s: float = LIMIT_S, status: int = 0) -> str:
    """Waits for the end; what was said on stderr. Fails unless the exit status is the given one."""
    try:
        _, errors = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise AssertionError(f"the run did not end in {limit_s:.0f} s; it said last: {_last_words(process)}") from None
    finally:
        process.kill()
    assert process.returncode == status, errors
    return errors


def wait_for(
    condition: Callable[[], object], process: subprocess.Popen[str], what: str, *, limit_s: float = LIMIT_S
) -> None:
    """Until the condition holds; fails when the process ends or takes too long before."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, f"the run ended before {what}: {process.communicate()[1]}"
        if time.monotonic() > deadline:
            raise AssertionError(f"{what} did not come in {limit_s:.0f} s; the run said last: {_last_words(process)}")
        time.sleep(0.02)


def _last_words(process: subprocess.Popen[str]) -> str:
    """Last output of a run that is ended for it."""
    process.kill()
    said, errors = process.communicate()
    return f"{said[-300:]} {errors[-1000:]}"


def rows(run: Path) -> list[dict[str, Any]]:
    """Metrics so far."""
    return read_lines(run / "metrics" / "metrics.jsonl").rows


def events(run: Path, kind: str, **details: Any) -> list[dict[str, Any]]:
    """Events of a kind so far, with these details."""
    found = (row for row in read_lines(run / "events.jsonl").rows if row["event"] == kind)
    return [row for row in found if all(row.get(name) == value for name, value in details.items())]


def kill_newest(run: Path, process_name: str) -> None:
    """SIGKILL for the process of a run that was started last under this name."""
    os.kill(events(run, "process_started", process=process_name)[-1]["pid"], signal.SIGKILL)
