"""Fault tests find a fault that is there; a miniature with real processes finds none."""

import json
import os
import subprocess
import sys

import numpy as np
import psutil
import pytest

from bench.fault_run import SHARED_MEMORY, FaultError, FaultRun, shared_memory
from bench.fault_tests import _same_bits
from tests.helpers import REPOSITORY, python_path


def test_bits_are_compared_and_not_values():
    nan = np.array([np.nan, 0.0], np.float32)
    assert _same_bits(nan, nan.copy())
    assert not _same_bits(nan, np.array([np.nan, -0.0], np.float32))
    assert not _same_bits(nan, nan.astype(np.float64))
    assert not _same_bits(nan, None)


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason="no /dev/shm here")
def test_shared_memory_that_nobody_holds_is_found():
    path = SHARED_MEMORY / f"test-faults-{os.getpid()}"
    try:
        with path.open("wb"):
            assert path.name not in shared_memory()
        assert path.name in shared_memory()
    finally:
        path.unlink()


def test_a_process_that_is_left_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("bench.fault_run.GONE_S", 0.5)
    run = FaultRun(tmp_path / "run", "colocated")
    assert run.left_processes() == []
    left = subprocess.Popen(["sleep", "60"])
    try:
        run._seen[left.pid] = psutil.Process(left.pid)
        assert run.left_processes() == [f"{left.pid} sleep 60"]
    finally:
        left.kill()
        left.wait()
    assert run.left_processes() == []


def test_a_command_that_ends_is_not_waited_for(tmp_path):
    run = FaultRun(tmp_path / "run", "colocated", ("--run.num_workers", "none"))
    run.start()
    with pytest.raises(FaultError, match=r"ended \(2\) before an update: .*num.workers"):
        run.wait_for_update()
    assert run.finished() == 2


@pytest.mark.slow
def test_a_run_of_which_two_processes_are_killed_has_the_bits_of_another(tmp_path):
    path = tmp_path / "faults.json"
    command = [sys.executable, "-m", "bench.fault_tests", "--kills", "2", "--json", str(path)]
    subprocess.run(command, cwd=REPOSITORY, env={**os.environ, "PYTHONPATH": python_path()}, check=True, timeout=900)
    (record,) = json.loads(path.read_text())
    assert sum(record["processes"].values()) == 2 and record["wrong"] == []
