"""Real Ray processes on CPU: the same numbers as in one process, whoever dies in between."""

import os
import signal

import numpy as np
import pytest

from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.curation import CuratorClient
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_updates, tiny_config


@pytest.fixture(scope="module")
def ray_backend():
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    backend = RayBackend(heartbeat_seconds=120.0)
    yield backend
    backend.stop()


def _run(config, path, backend, reporter=None, at_update=None):
    """Colocated or split as the config says; returns (controller, trainer, curator)."""
    placement = plan(config, num_gpus=0)
    if config.run.placement == "split":
        trainer = SplitTrainer(config, backend, placement)
    else:
        trainer = ColocatedTrainer(config, backend, placement.of("worker"))
    curator = CuratorClient(config, backend, placement.of("curator")[0])
    reporter = reporter or QuietReporter(lambda number: at_update(number, trainer, curator) if at_update else None)
    try:
        return run_updates(config, path, trainer, curator, reporter=reporter), reporter
    finally:
        curator.stop()
        trainer.stop()


@pytest.fixture(scope="module")
def local_arrays(tmp_path_factory):
    """Of eight updates in this process: what every lag-0 run with one worker has to reproduce."""
    path = tmp_path_factory.mktemp("local")
    config = tiny_config(num_updates=8, placement="colocated")
    _run(config, path / "run", LocalBackend())
    return final_arrays(path / "run")


def test_ray_colocated_gives_the_same_parameters_as_local_mode_bit_for_bit(ray_backend, local_arrays, tmp_path):
    _run(tiny_config(num_updates=8, placement="colocated"), tmp_path / "ray", ray_backend)
    assert_same_bits(final_arrays(tmp_path / "ray"), local_arrays)


def test_killing_the_worker_and_the_curator_costs_time_and_changes_nothing_else(ray_backend, local_arrays, tmp_path):
    def kill(number, trainer, curator):
        if number == 4 and curator.num_restarts == 0:
            os.kill(curator._handle.pid, signal.SIGKILL)  # the refresh asked for at update 3 is in flight or done
        if number == 7 and not killed:
            killed.append(trainer._handles[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    killed = []
    config = tiny_config(num_updates=8, placement="colocated")
    controller, reporter = _run(config, tmp_path / "ray", ray_backend, at_update=kill)
    assert controller.num_restarts == 1
    assert [row["update"] for row in reporter.rows] == [1, 2, 3, 4, 5, 6, 7, 7, 8]  # back to the checkpoint of 6
    assert reporter.rows[-1]["runtime/restarts"] >= 1
    assert reporter.rows[-1]["runtime/recovery_seconds"] > 0
    assert_same_bits(final_arrays(tmp_path / "ray"), local_arrays)


def test_two_workers_over_gloo_agree_with_one(ray_backend, local_arrays, tmp_path):
    config = tiny_config(num_updates=8, placement="colocated", num_workers=2)
    _run(config, tmp_path / "ray", ray_backend)
    arrays = final_arrays(tmp_path / "ray")
    for name, expected in local_arrays.items():
        if name.startswith("learner/params"):
            # float32 sums in another order, 32 gradient steps of size 1e-3 each: Adam turns a rounding difference
            # of a near-zero gradient into up to a step, so single parameters may differ by a few steps' rounding.
            np.testing.assert_allclose(arrays[name], expected, atol=2e-4, err_msg=name)
        elif name.startswith("buffer/levels"):
            np.testing.assert_array_equal(arrays[name].shape, expected.shape)
    assert arrays["learner/num_updates"] == 8


def test_a_killed_rollout_actor_is_replaced_and_its_steps_are_counted_as_dropped(ray_backend, tmp_path):
    config = tiny_config(num_updates=6, placement="split", num_rollout_actors=2)
    _run(config, tmp_path / "local", LocalBackend())

    def kill(number, trainer, curator):
        if number == 3:
            os.kill(trainer._actors[1].pid, signal.SIGKILL)

    _, reporter = _run(config, tmp_path / "ray", ray_backend, at_update=kill)
    assert [row["runtime/policy_lag"] for row in reporter.rows] == [0, 1, 1, 1, 1, 1]
    dropped = reporter.rows[-1]["runtime/dropped_steps"]
    part = config.rollout.steps_per_update // 2
    assert dropped in (part, 2 * part)  # one or two of its batches were in flight
    assert_same_bits(final_arrays(tmp_path / "ray"), final_arrays(tmp_path / "local"))
