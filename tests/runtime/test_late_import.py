"""tensorboardX imports PyTorch where that is installed: neither the start of a run nor a row waits for it."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from kinetix_dist.runtime.driver.reporting import RunReporter
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.sinks import TensorboardSink
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from tests.helpers import PATIENCE_S, environment_of_cpus


def test_it_is_not_imported_with_what_trains() -> None:
    program = "import sys; import kinetix_dist.runtime.driver.training_run; print('tensorboardX' in sys.modules)"
    command = [sys.executable, "-c", program]
    found = subprocess.run(
        command, env=environment_of_cpus(1), check=True, capture_output=True, text=True, timeout=PATIENCE_S
    ).stdout
    assert found.split() == ["False"]


def test_it_is_imported_while_others_are_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imported = []
    monkeypatch.setattr(TensorboardSink, "prepare", classmethod(lambda cls: imported.append(time.monotonic())))
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = RunReporter(run, ConsoleSink(total_env_steps=None))
    assert not imported
    for name in ("evaluating", "compiling"):
        reporter.phase(name)
    deadline = time.monotonic() + PATIENCE_S
    while not imported and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(imported) == 1
    reporter.metrics(1, {"progress/env_steps": 8.0}, None)
    reporter.close()
    assert list(run.metrics.glob("events.out.tfevents.*"))
