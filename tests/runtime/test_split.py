"""The split placement: several learners and rollout actors, whichever of them are lost."""

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from kinetix_dist.checkpoint import newest_good
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.driver.work_buffer import TIMES_THE_OTHERS
from kinetix_dist.runtime.processes.placement import plan_placement
from kinetix_dist.runtime.processes.provenance import what_differs
from kinetix_dist.telemetry.names import COPIES
from tests.helpers import PATIENCE_S, REPOSITORY, environment_of_cpus
from tests.runtime.runs import NotingReporter, QuietReporter, assert_same_bits, final_arrays, run_updates
from tests.runtime.split_program import NUM_UPDATES, split_config
from tests.runtime.train_process import STEPS_PER_UPDATE, TINY, events, rows, start, wait_for

PROGRAM = REPOSITORY / "tests" / "runtime" / "split_program.py"


def _on_two_devices(path, curriculum):
    """Arrays of one learner with two devices, in a process of its own."""
    command = [sys.executable, str(PROGRAM), str(path), curriculum]
    done = subprocess.run(command, env=environment_of_cpus(2), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return final_arrays(path)


OPTIMISED = True  # several processes and one have the same bits: see tests/conftest.py


@pytest.fixture(scope="module")
def two_devices(tmp_path_factory):
    return _on_two_devices(tmp_path_factory.mktemp("two") / "run", "domain_randomization")


@pytest.fixture(scope="module")
def ray_backend():
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    backend = RayBackend(heartbeat_seconds=120.0)
    yield backend
    backend.stop()


def _train(config, path, backend, *, at_update=lambda number, trainer: None, resume=False, reporter=None):
    """Rows of metrics."""
    trainer = SplitTrainer(config, backend, plan_placement(config, num_gpus=0))
    reporter = reporter or QuietReporter(lambda number: at_update(number, trainer))
    try:
        run_updates(config, path, trainer, None, reporter=reporter, resume=resume)
    finally:
        trainer.stop()
    return reporter.rows


def _kill(*handles):
    for handle in handles:
        os.kill(handle.pid, signal.SIGKILL)


# Who is lost after update 3, and which updates there are then; a checkpoint is saved every second update.
LOSSES = {
    "learner and actor": (lambda trainer: [trainer._learners[1], trainer._actors[0]], [1, 2, 3, 3, 4, 5]),
    "first learner": (lambda trainer: trainer._learners[:1], [1, 2, 3, 3, 4, 5]),
    "both learners": (lambda trainer: trainer._learners, [1, 2, 3, 3, 4, 5]),
    "both actors": (lambda trainer: trainer._actors, [1, 2, 3, 4, 5]),
}
IN_MAKE_TEST = "learner and actor"


@pytest.mark.long
@pytest.mark.parametrize(
    "who", [pytest.param(who, marks=[] if who == IN_MAKE_TEST else pytest.mark.slow) for who in LOSSES]
)
def test_learners_and_actors_that_are_lost_change_no_bit_of_what_one_learner_learns(
    ray_backend, two_devices, tmp_path, who
):
    """Two learners and two actors of one device each are one learner and one actor of two."""
    lost_of, expected = LOSSES[who]
    killed = []

    def kill(number, trainer):
        if number == 3 and not killed:
            killed.extend(lost_of(trainer))
            _kill(*killed)

    # As many worlds on each device: for other batches a CPU may round otherwise.
    config = split_config(num_learners=2, num_rollout_actors=2)
    rows = _train(config, tmp_path / "run", ray_backend, at_update=kill)
    assert len(killed) in (1, 2) and events(tmp_path / "run", "process_lost")
    if who == "both actors":
        assert {row["section"] for row in events(tmp_path / "run", "recovered", role="rollout")} == {"update"}
        assert rows[-1]["runtime/restarts_rollout"] >= 1
        assert {row["runtime/policy_lag"] for row in rows[1:]} == {1}
    assert [row["update"] for row in rows] == expected
    assert_same_bits(final_arrays(tmp_path / "run"), two_devices)
    checkpoint, _ = newest_good(tmp_path / "run" / "checkpoints")
    assert checkpoint is not None
    description = checkpoint.description
    found = {"learners": 2, "rollout_actors": config.run.num_rollout_actors, "devices": 2}
    assert description["topology"].items() >= found.items()
    other = description["topology"] | {"learners": 1, "devices": 1}
    assert set(what_differs(description, other)) == {"learners 1 instead of 2", "devices 1 instead of 2"}
    copied = {name.removesuffix("_mib") for name in rows[-1] if name.startswith("copies/") and name.endswith("_mib")}
    # Each learner has the worlds that one actor plays.
    assert copied == {f"copies/{name}" for name in COPIES}
    batch_mib = rows[-1]["copies/device_to_host_mib"]
    assert rows[-1]["copies/store_put_mib"] == rows[-1]["copies/host_to_device_mib"] == batch_mib > 0
    part = config.rollout.steps_per_update // config.run.num_rollout_actors
    dropped = rows[-1]["runtime/dropped_steps"]  # of the one or two batches that were being played at each loss
    # Two that die may be noticed as one; on a slow machine the limit of an update may make one more.
    num_lost = max(len(killed), len(events(tmp_path / "run", "process_lost")))
    assert 0 < dropped <= 2 * num_lost * config.rollout.steps_per_update and dropped % part == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("curriculum", "is_seen"),
    [
        ("plr", lambda arrays: (arrays["curriculum/born"] > 0).any()),  # levels of updates after the first
        ("paired", lambda arrays: arrays["curriculum/antagonist/num_updates"] == NUM_UPDATES),
    ],
)
def test_learners_see_the_outcomes_of_all_actors_where_a_curriculum_observes(
    curriculum, is_seen, ray_backend, tmp_path
):
    """Two actors, since they play as many worlds at a time as each of two devices does: with other numbers at a time,
    values and probabilities of actions differ in their last bit, whatever the curriculum."""
    config = split_config(curriculum, num_learners=2, num_rollout_actors=2)
    _train(config, tmp_path / "run", ray_backend)
    arrays = final_arrays(tmp_path / "run")
    assert is_seen(arrays)
    assert_same_bits(arrays, _on_two_devices(tmp_path / "two", curriculum))


@pytest.mark.slow
def test_a_run_goes_on_with_other_numbers_of_learners_and_actors_and_says_so(ray_backend, two_devices, tmp_path):
    config, path = split_config(num_learners=2, num_rollout_actors=2), tmp_path / "run"
    shorter = dataclasses.replace(config.run, total_env_steps=3 * config.rollout.steps_per_update)
    _train(dataclasses.replace(config, run=shorter), path, ray_backend)
    reporter = NotingReporter()
    other = split_config(num_learners=1, num_rollout_actors=3)
    assert other.hash == config.hash
    _train(other, path, ray_backend, resume=True, reporter=reporter)
    found = " ".join(reporter.notes)
    for words in ("learners 1 instead of 2", "rollout_actors 3 instead of 2", "devices 1 instead of 2"):
        assert words in found
    assert "not bit for bit" in found
    arrays = final_arrays(path)
    for name, expected in two_devices.items():
        if name.startswith("learner/params"):
            # Two updates of four gradient steps of size 1e-3 with sums in another order.
            np.testing.assert_allclose(arrays[name], expected, atol=2e-4, err_msg=name)
    assert arrays["learner/num_updates"] == NUM_UPDATES


def _hold_back(pid, is_over):
    """Lets a process run for a tenth of the time."""
    while not is_over.wait(0.01):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.09)
        os.kill(pid, signal.SIGCONT)


@pytest.mark.slow
def test_an_actor_that_is_held_back_is_named_and_lag_stays_bounded(tmp_path):
    run, is_over = tmp_path / "run", threading.Event()
    steps = str(100_000 * STEPS_PER_UPDATE)
    split = ["--run.placement", "split", "--run.num_rollout_actors", "3", "--run.total_env_steps", steps]
    driver = start(run, *TINY, *split)
    try:
        wait_for(lambda: len(rows(run)) >= 5, driver, "five updates")
        pid = events(run, "process_started", process="rollout 1")[0]["pid"]
        holding = threading.Thread(target=_hold_back, args=(pid, is_over))
        holding.start()
        try:
            wait_for(lambda: events(run, "straggler", process="rollout 1"), driver, "the event")
        finally:
            is_over.set()
            holding.join()
        driver.send_signal(signal.SIGTERM)
        driver.communicate(timeout=PATIENCE_S)
    finally:
        driver.kill()
    found = events(run, "straggler", process="rollout 1")[0]
    assert found["seconds"] > TIMES_THE_OTHERS * found["seconds_of_others"] > 0
    assert max(row["runtime/policy_lag_max"] for row in rows(run)) == 1
    assert rows(run)[-1]["runtime/dropped_steps"] == 0
