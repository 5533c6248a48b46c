"""Evaluations and recordings during training, by a process of their own: what they say, and what losing it costs."""

import dataclasses
import os
import shutil
import signal

import pytest

from kinetix_dist.checkpoint import list_checkpoints
from kinetix_dist.config import RecordingConfig
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.evaluations import MAX_WAITING, Evaluations
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan_placement
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_directory, tiny_config
from tests.runtime.train_process import events

NUM_UPDATES, EVERY = 8, 2


def _config(placement="colocated"):
    config = tiny_config(num_updates=NUM_UPDATES, placement=placement, checkpoint_every=EVERY)
    return dataclasses.replace(
        config,
        evaluation=dataclasses.replace(config.evaluation, every=EVERY),
        recording=RecordingConfig(num_rollouts=1, every=EVERY, make_pictures=False),
    )


def _train(config, path, backend, *, in_background=True, resume=False):
    """(rows of metrics, policy versions that were recorded)"""
    run, placement, recorded = run_directory(path, config, resume=resume), plan_placement(config, num_gpus=0), []
    if config.run.placement == "split":
        trainer = SplitTrainer(config, backend, placement)
    else:
        trainer = ColocatedTrainer(config, backend, placement.of("worker"))
    curator = CuratorClient(config, backend, placement.of("curator"))

    def record(rollouts):
        recorded.extend(rollout.policy_version for rollout in rollouts)

    callbacks = {"on_event": run.event, "on_rollouts": record}
    evaluations = Evaluations(config, trainer, placement.of("evaluator")[0], **callbacks) if in_background else None
    reporter = QuietReporter()
    try:
        controller = Controller(
            config, run, Roles(trainer=trainer, curator=curator, evaluations=evaluations), reporter, on_rollouts=record
        )
        controller.restore(resume=resume)
        controller.train()
        return reporter.rows, recorded
    finally:
        for role in filter(None, (evaluations, curator, trainer)):
            role.stop()
        run.close()


def _rates(rows):
    """Solve rates by the update whose weights were evaluated."""
    found = [row for row in rows if "evaluation/update" in row]
    return {
        row["evaluation/update"]: {name: row[name] for name in row if name.startswith("evaluation/s")} for row in found
    }


@pytest.fixture(scope="module")
def waited_for(tmp_path_factory):
    """(rows, recorded, arrays) of a run whose trainer evaluates while training waits."""
    path = tmp_path_factory.mktemp("background") / "here"
    rows, recorded = _train(_config(), path, LocalBackend(), in_background=False)
    return rows, recorded, final_arrays(path)


@pytest.mark.long
def test_what_was_in_flight_at_a_checkpoint_is_done_again_by_a_run_that_goes_on_from_it(waited_for, tmp_path):
    """One evaluation comes with each update here, so that the recording due with it is in flight until the next one."""
    rows, recorded, arrays = waited_for
    assert recorded == [2, 4, 6, 8] and set(_rates(rows)) == {2, 4, 6, 8}
    found, versions = _train(_config(), tmp_path / "run", LocalBackend())
    assert versions == recorded and _rates(found) == _rates(rows)
    assert_same_bits(final_arrays(tmp_path / "run"), arrays)
    for path in list_checkpoints(tmp_path / "run" / "checkpoints"):
        if int(path.name) > 4:
            shutil.rmtree(path)
    found, versions = _train(_config(), tmp_path / "run", LocalBackend(), resume=True)
    assert versions == [4, 6, 8] and set(_rates(found)) == {6, 8}
    assert_same_bits(final_arrays(tmp_path / "run"), arrays)


@pytest.mark.slow  # starts seven processes
@pytest.mark.parametrize("placement", ["colocated", "split"])
def test_a_killed_evaluator_costs_no_training_and_says_the_same_later(waited_for, tmp_path, placement):
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    killed = []

    def kill(kind, **details):
        if kind == "process_started" and details["process"] == "evaluator 0" and not killed:
            killed.append(details["pid"])
            os.kill(details["pid"], signal.SIGKILL)

    backend = RayBackend(heartbeat_seconds=60.0, on_event=kill)
    try:
        rows, recorded = _train(_config(placement), tmp_path / "ray", backend)
    finally:
        backend.stop()
    assert killed
    assert [row["process"] for row in events(tmp_path / "ray", "process_lost")] == ["evaluator 0"]
    assert [row["update"] for row in rows] == list(range(1, NUM_UPDATES + 1))  # no update was done again
    evaluated = {row["update"]: row["solve_rate"] for row in events(tmp_path / "ray", "evaluated")}
    left_out = [row["update"] for row in events(tmp_path / "ray", "evaluation_left_out")]
    assert len(evaluated) >= MAX_WAITING // 2
    assert sorted([*evaluated, *recorded, *left_out]) == sorted([2, 4, 6, 8] * 2)
    if placement == "colocated":  # the same weights as in one process
        here = _rates(waited_for[0])
        assert all(rates["s/kick"]["rate"] == here[n]["evaluation/s/kick/solve_rate"] for n, rates in evaluated.items())
        assert_same_bits(final_arrays(tmp_path / "ray"), waited_for[2])
