"""Processes of a run are ended at random times, two at once now and then: it ends as if nothing had been."""

import json
import os
import random
import shutil
import signal
import time

import psutil
import pytest

from tests.runtime.runs import assert_same_bits, final_arrays
from tests.runtime.train_process import STEPS_PER_UPDATE, TINY, events, rows, start

NUM_KILLS = 20
NUM_UPDATES = 240
LIMIT_S = 1500.0
SEED = 11


def _options(placement):
    workers = {"colocated": ["--run.num_workers", "2"], "split": ["--run.num_rollout_actors", "2"]}
    return [
        *TINY,
        *(
            "--run.placement",
            placement,
            *workers[placement],
            "--run.total_env_steps",
            str(NUM_UPDATES * STEPS_PER_UPDATE),
        ),
        *("--run.max_restarts", "1000", "--run.checkpoint_every", "10", "--recording.num_rollouts", "1"),
        *("--recording.make_pictures", "False", "--evaluation.every", "60"),
    ]


def _processes(run):
    """Those of the run that live, by process id."""
    started = {row["pid"]: row["process"] for row in events(run, "process_started")}
    return {pid: name for pid, name in started.items() if psutil.pid_exists(pid)}


def _kill_at_random(run, process, number):
    """Until `number` processes were ended; which."""
    choose, killed = random.Random(SEED), []
    deadline = time.monotonic() + LIMIT_S
    while len(killed) < number and process.poll() is None and time.monotonic() < deadline:
        time.sleep(choose.uniform(0.5, 12.0))
        living = _processes(run)
        for pid in choose.sample(sorted(living), k=min(len(living), choose.choice([1, 1, 2]))):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:  # it ended by itself, with its group
                continue
            killed.append(living[pid])
    return killed


@pytest.mark.slow
@pytest.mark.parametrize("placement", ["colocated", "split"])
def test_a_run_whose_processes_are_killed_at_random_ends_as_an_unbroken_one(tmp_path, placement):
    run = tmp_path / "run"
    process = start(run, *_options(placement))
    below: set[int] = set()
    killed = _kill_at_random(run, process, NUM_KILLS)
    below |= {child.pid for child in psutil.Process(process.pid).children(recursive=True)}
    output, errors = process.communicate(timeout=LIMIT_S)
    print(placement, killed, [row["seconds"] for row in events(run, "recovered")])
    assert process.returncode == 0, errors
    assert "Traceback" not in output + errors
    assert len(killed) >= NUM_KILLS
    assert [row["update"] for row in rows(run)] == list(range(1, NUM_UPDATES + 1))
    assert not [pid for pid in below if psutil.pid_exists(pid)]
    # The same without a loss, told only from which updates on buffers were used.
    whole = tmp_path / "whole"
    whole.mkdir()
    shutil.copy(run / "adoptions.json", whole)
    unbroken = start(whole, *_options(placement))
    _, errors = unbroken.communicate(timeout=LIMIT_S)
    assert unbroken.returncode == 0, errors
    assert not events(whole, "process_lost")
    assert json.loads((whole / "adoptions.json").read_text()) == json.loads((run / "adoptions.json").read_text())
    assert_same_bits(final_arrays(run), final_arrays(whole))
