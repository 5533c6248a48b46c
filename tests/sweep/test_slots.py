"""Worker slots of a sweep: cores, the signal when the sweep dies, and devices that a process sees."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kinetix_dist.sweep.slots import Slot
from tests.helpers import PATIENCE_S, REPOSITORY, python_path

# Instead of Python, which it becomes: writes which cores it has, and when it is stopped.
SHELL = """#!/bin/sh
trap 'echo stopped >> {file}; exit 75' TERM
echo "$(grep Cpus_allowed_list /proc/self/status) $*" >> {file}
for number in $(seq 200); do sleep 0.05; done
"""
# A sweep: starts it, and waits.
PARENT = """
import subprocess, sys
code = "import sys; sys.executable = {shell!r}; from kinetix_dist.sweep.slots import become; become(*{arguments})"
child = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
sys.exit(child.wait())
"""


def _wait_for(file: Path, text: str) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while text not in (said := file.read_text() if file.exists() else ""):
        assert time.monotonic() < deadline, said
        time.sleep(0.02)
    return said


def _start(tmp_path, parent: str = "__import__('os').getppid()"):
    shell = tmp_path / "shell"
    shell.write_text(SHELL.format(file=tmp_path / "said"))
    shell.chmod(0o755)
    core = min(os.sched_getaffinity(0))
    arguments = f"('{core}', {parent}, ['train', '--run', 'x'])"
    code = PARENT.format(shell=str(shell), arguments=arguments)
    environment = os.environ | {"PYTHONPATH": python_path()}
    return core, subprocess.Popen([sys.executable, "-c", code], env=environment, cwd=REPOSITORY, stderr=subprocess.PIPE)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_run_has_its_cores_and_is_stopped_when_the_sweep_dies(tmp_path, number):
    core, sweep = _start(tmp_path)
    said = _wait_for(tmp_path / "said", "train")
    assert f"Cpus_allowed_list:\t{core} -P " in said and "kinetix_dist.cli.main train --run x" in said
    sweep.send_signal(number)
    sweep.wait()
    _wait_for(tmp_path / "said", "stopped")


def test_nothing_runs_where_the_sweep_is_gone_already(tmp_path):
    _, sweep = _start(tmp_path, parent="1")
    assert b"the sweep is gone" in sweep.communicate(timeout=PATIENCE_S)[1] and sweep.returncode == 1
    assert not (tmp_path / "said").exists()


def test_slots_show_their_devices_alone():
    assert Slot(name="gpu 3", gpu="3").environment == {"CUDA_VISIBLE_DEVICES": "3"}
    assert Slot(name="cpu 0", cores=(0,)).environment == {"CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}
