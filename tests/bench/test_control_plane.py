"""The cost of the control plane is measured: a miniature on real Ray processes, and what does not fit."""

import json
import os
import subprocess
import sys

import psutil
import pytest

from bench import control_plane
from tests.helpers import REPOSITORY, python_path


@pytest.mark.slow
def test_two_processes_are_started_and_asked(tmp_path):
    path = tmp_path / "control_plane.json"
    command = [sys.executable, "-m", "bench.control_plane", "--processes", "2", "--json", str(path)]
    environment = {**os.environ, "PYTHONPATH": python_path(), "JAX_PLATFORMS": "cpu"}
    subprocess.run(command, cwd=REPOSITORY, env=environment, check=True, timeout=300, capture_output=True)
    (record,) = json.loads(path.read_text())
    assert record["processes"] == 2 and 0 < record["start_seconds"] < 200
    assert 0 < record["update_milliseconds"] <= record["update_milliseconds_slowest"]
    assert 50 < record["resident_mib_per_process"] < 2000


def test_what_memory_does_not_hold_is_left_out():
    record = control_plane.measure(psutil.virtual_memory().total // control_plane.BYTES_PER_PROCESS + 1)
    assert "MiB of memory are free" in str(record["left_out"]) and "start_seconds" not in record
