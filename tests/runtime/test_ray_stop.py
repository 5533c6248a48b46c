"""`ray stop --force` next to a run, or the end of a server of Ray: the run ends with one line and leaves nothing."""

import json
import os
import re
import shutil
import subprocess
import sys
import time

import psutil
import pytest

from tests.helpers import REPOSITORY, python_path
from tests.runtime.ray_stop_program import GONE_S, OPTIONS
from tests.runtime.runs import assert_same_bits, final_arrays
from tests.runtime.sockets import family
from tests.runtime.train_process import LIMIT_S, STEPS_PER_UPDATE, events, finish, rows, start, wait_for

# It ends all Ray processes that it can see: of this test alone.
ALONE = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child"]


def _can_be_alone():
    return shutil.which(ALONE[0]) is not None and subprocess.run([*ALONE, "true"], check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not _can_be_alone(), reason="needs a process namespace: unshare, and the right to use it")
def test_a_run_whose_ray_is_stopped_ends_with_one_line_and_goes_on_bit_for_bit(tmp_path):
    run = tmp_path / "run"
    command = [*ALONE, sys.executable, "-m", "tests.runtime.ray_stop_program", str(run)]
    environment = {**os.environ, "PYTHONPATH": python_path()}
    done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    outcome = json.loads(done.stdout.splitlines()[-1])
    assert outcome["status"] == 1, outcome
    line = outcome["errors"].strip().splitlines()[-1]
    # Both servers are ended; which of them was gone when it was noticed is a matter of time.
    assert re.match(r"kinetix-dist: Ray was ended on this machine \((gcs_server|raylet|gcs_server, raylet)\)", line), (
        line
    )
    assert line.endswith(f"try again with --run {run} --resume") and "Traceback" not in outcome["errors"]
    assert outcome["seconds"] < 30.0 and outcome["left"] == []
    assert events(run, "run_failed")
    total = str((rows(run)[-1]["update"] + 5) * STEPS_PER_UPDATE)
    finish(start(run, "--resume", "--run.total_env_steps", total))
    whole = tmp_path / "whole"
    whole.mkdir()
    shutil.copy(run / "adoptions.json", whole)
    finish(start(whole, *OPTIONS, "--run.total_env_steps", total))
    assert_same_bits(final_arrays(run), final_arrays(whole))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["raylet", "gcs_server"])
def test_a_run_that_loses_a_server_of_ray_ends_with_one_line_and_leaves_nothing(name, tmp_path):
    run = tmp_path / "run"
    process = start(run, *OPTIONS, "--run.total_env_steps", str(10**6 * STEPS_PER_UPDATE))
    wait_for(lambda: len(rows(run)) >= 7, process, "update 7")
    everyone = family(process.pid)
    (server,) = [one for one in everyone if one.name() == name]
    server.kill()
    began = time.monotonic()
    _, errors = process.communicate(timeout=LIMIT_S)
    assert time.monotonic() - began < 30.0
    assert process.returncode == 1 and "Traceback" not in errors
    line = errors.strip().splitlines()[-1]
    assert line.startswith(f"kinetix-dist: Ray was ended on this machine ({name})"), errors
    assert line.endswith(f"try again with --run {run} --resume")
    _, left = psutil.wait_procs(everyone, timeout=GONE_S)
    assert not left
    finish(start(run, "--resume", "--run.total_env_steps", str((rows(run)[-1]["update"] + 2) * STEPS_PER_UPDATE)))
