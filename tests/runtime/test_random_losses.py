"""Processes of a run are ended at random times, two at once now and then: it ends as if nothing had been."""

import collections
import json
import os
import random
import shutil
import signal
import statistics
import time

import psutil
import pytest

from kinetix_dist.runtime.driver.stopping import EXIT_STOPPED
from kinetix_dist.runtime.processes.watchdog import is_alive
from kinetix_dist.telemetry.names import ROLES
from tests.runtime.runs import assert_same_bits, final_arrays
from tests.runtime.train_process import STEPS_PER_UPDATE, TINY, events, finish, rows, start

NUM_KILLS = 20
# Half of the kills come some time after the one before, which is mostly within its recovery; the others come a while
# after the first update that follows it.
AFTER_KILL_S = (0.5, 25.0)
AFTER_UPDATE_S = (0.0, 2.0)
LIMIT_S = 600.0
SEED = 11


def _options(placement):
    workers = {
        "colocated": ["--run.num_workers", "2"],
        "split": ["--run.num_learners", "2", "--run.num_rollout_actors", "2"],
    }
    return [
        *(*TINY, "--run.placement", placement, *workers[placement]),
        *("--run.max_restarts", "1000", "--run.checkpoint_every", "10", "--recording.num_rollouts", "1"),
        *("--recording.make_pictures", "False", "--evaluation.every", "100"),
    ]


def _until(num_updates):
    return ["--run.total_env_steps", str(num_updates * STEPS_PER_UPDATE)]


def _living(run, driver):
    """Processes of the run by process id. Descendants of the driver alone: a number may be another's by now."""
    names = {row["pid"]: row["process"] for row in events(run, "process_started")}
    below = psutil.Process(driver.pid).children(recursive=True)
    return {child.pid: names[child.pid] for child in below if child.pid in names and is_alive(child)}


def _kill_at_random(run, driver, number):
    """Until `number` processes were ended. ([who], all processes below the driver that were seen)."""
    choose, killed, seen = random.Random(SEED), [], set()
    deadline = time.monotonic() + LIMIT_S
    while len(killed) < number and driver.poll() is None:
        assert time.monotonic() < deadline, f"{len(killed)} kills in {LIMIT_S:.0f} s"
        if choose.random() < 0.5:
            time.sleep(choose.uniform(*AFTER_KILL_S))
        else:
            _wait_for_update(run, driver, since=time.time())
            time.sleep(choose.uniform(*AFTER_UPDATE_S))
        if driver.poll() is not None:
            break
        seen |= set(psutil.Process(driver.pid).children(recursive=True))
        living = _living(run, driver)
        for pid in choose.sample(sorted(living), k=min(len(living), choose.choice([1, 1, 2]))):
            os.kill(pid, signal.SIGKILL)
            killed.append(living[pid])
    return killed, seen


def _wait_for_update(run, driver, *, since):
    path, deadline = run / "metrics" / "metrics.jsonl", time.monotonic() + LIMIT_S
    while driver.poll() is None and not (path.exists() and path.stat().st_mtime > since):
        assert time.monotonic() < deadline, f"no update in {LIMIT_S:.0f} s"
        time.sleep(0.1)


def _tell(placement, killed, run, seconds):
    """Prints the outcome, for `pytest -s`."""
    lost = events(run, "process_lost")
    recovered = {role: [row["seconds"] for row in events(run, "recovered", role=role)] for role in ROLES}
    seconds = {
        role: f"{len(seconds)}, median {statistics.median(seconds):.1f} s, max {max(seconds):.1f} s"
        for role, seconds in recovered.items()
        if seconds
    }
    sections = dict(collections.Counter(row["section"] for row in lost))
    print(f"\n{placement}: killed {dict(collections.Counter(killed))}, {seconds:.0f} s in all")
    print(f"  {len(lost)} losses, by section {sections}; recoveries {seconds}; late {len(events(run, 'buffer_late'))}")


@pytest.mark.slow
@pytest.mark.parametrize("placement", ["colocated", "split"])
def test_a_run_whose_processes_are_killed_at_random_ends_as_an_unbroken_one(tmp_path, placement):
    run, began = tmp_path / "run", time.monotonic()
    driver = start(run, *_options(placement), *_until(10**6))
    try:
        killed, seen = _kill_at_random(run, driver, NUM_KILLS)
        _wait_for_update(run, driver, since=time.time())
        driver.send_signal(signal.SIGTERM)
        output, errors = driver.communicate(timeout=LIMIT_S)
    finally:
        driver.kill()
    _tell(placement, killed, run, time.monotonic() - began)
    assert driver.returncode == EXIT_STOPPED, errors
    assert "Traceback" not in output + errors
    # As long as it takes on this machine, and then to an end of its own.
    num_updates = rows(run)[-1]["update"] + 1
    finish(start(run, "--resume", *_until(num_updates)), limit_s=LIMIT_S)
    assert [row["update"] for row in rows(run)] == list(range(1, num_updates + 1))
    assert not [process for process in seen if is_alive(process)]
    # The same without a loss, given adoptions.json.
    whole = tmp_path / "whole"
    whole.mkdir()
    shutil.copy(run / "adoptions.json", whole)
    finish(start(whole, *_options(placement), *_until(num_updates)), limit_s=LIMIT_S)
    assert not events(whole, "process_lost")
    assert json.loads((whole / "adoptions.json").read_text()) == json.loads((run / "adoptions.json").read_text())
    assert_same_bits(final_arrays(run), final_arrays(whole))
