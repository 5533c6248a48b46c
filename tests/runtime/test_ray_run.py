"""Real Ray processes on CPU: the same numbers as in one process, whichever process dies in between."""

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.config import from_dict, to_dict
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.registry import PluginError, import_plugins
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import MIN_PATIENCE_S, CuratorClient, WorkerCurator
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan_placement
from tests.runtime.foreign_checkout import foreign_checkout
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_updates, tiny_config
from tests.runtime.train_process import events


@pytest.fixture(scope="module")
def ray_backend(tmp_path_factory):
    """Ray that is started in a directory with another checkout: processes import what this one does."""
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    with contextlib.chdir(foreign_checkout(tmp_path_factory.mktemp("foreign"))):
        backend = RayBackend(heartbeat_seconds=120.0)
    yield backend
    backend.stop()


def _run(config, path, backend, reporter=None, at_update=None, resume=False):
    """Colocated or split as the config says; returns (controller, trainer, curator)."""
    placement = plan_placement(config, num_gpus=0)
    if config.run.placement == "split":
        trainer = SplitTrainer(config, backend, placement)
    else:
        trainer = ColocatedTrainer(config, backend, placement.of("worker"))
    if config.run.num_curators:
        curator = CuratorClient(config, backend, placement.of("curator")) if config.has_curator else None
    else:
        assert isinstance(trainer, ColocatedTrainer)
        curator = WorkerCurator(trainer)
    reporter = reporter or QuietReporter(lambda number: at_update(number, trainer, curator) if at_update else None)
    try:
        return run_updates(config, path, trainer, curator, reporter=reporter, resume=resume), reporter
    finally:
        for role in filter(None, (curator, trainer)):
            role.stop()


@pytest.fixture(scope="module")
def local_arrays(tmp_path_factory):
    """Arrays of eight updates in this process, which every lag-0 run with one worker has to reproduce."""
    path = tmp_path_factory.mktemp("local")
    config = tiny_config(num_updates=8, placement="colocated")
    _run(config, path / "run", LocalBackend())
    return final_arrays(path / "run")


@pytest.mark.slow  # the next test shows it too, of runs whose processes are killed
def test_ray_colocated_gives_the_same_parameters_as_local_mode_bit_for_bit(ray_backend, local_arrays, tmp_path):
    _run(tiny_config(num_updates=8, placement="colocated"), tmp_path / "ray", ray_backend)
    assert_same_bits(final_arrays(tmp_path / "ray"), local_arrays)


@pytest.mark.long
def test_a_curator_a_worker_and_the_one_in_its_place_are_killed_and_nothing_is_lost(ray_backend, tmp_path, monkeypatch):
    """One of two curators dies with its part of the refresh of update 3, due at 5: training goes on, and the buffer
    comes late or never.

    An unbroken run with that adoptions.json, which has one curator, is the same, bit for bit.
    """
    times, killed = {}, []

    def kill(number, trainer, curator):
        times.setdefault(number, time.monotonic())
        if number == 3:
            os.kill(curator.processes[1]._handle.pid, signal.SIGKILL)
        if number == 7 and not killed:
            killed.append(trainer._handles[0].pid)
            os.kill(killed[0], signal.SIGABRT)  # as a failed check of XLA does, which leaves its frames

    def listen(kind, **details):
        if kind == "process_started" and details["process"] == "worker 0" and len(killed) == 1:
            killed.append(details["pid"])
            os.kill(details["pid"], signal.SIGKILL)

    monkeypatch.setattr(ray_backend, "_on_event", listen)
    config, ray = tiny_config(num_updates=10, placement="colocated", num_curators=2), tmp_path / "ray"
    _, reporter = _run(config, ray, ray_backend, at_update=kill)
    lost = [(row["process"], row["section"]) for row in events(ray, "process_lost")]
    assert lost == [("curator 1", "curate"), ("worker 0", "update"), ("worker 0", "recover")]
    crash = Path(events(ray, "process_lost", section="update")[0]["log"])
    assert crash == ray / "logs" / "worker_0.log" and "SIGABRT" in crash.read_text()
    # Nobody waited for the curator; back to the checkpoint of 6 with the worker, whose recovery ends with an update.
    waited = {row["update"]: row["time/curate"] for row in reporter.rows if row["update"] in (4, 5, 6)}  # shares
    assert all(share * (times[update] - times[update - 1]) < MIN_PATIENCE_S for update, share in waited.items())
    assert [row["update"] for row in reporter.rows] == [1, 2, 3, 4, 5, 6, 7, 7, 8, 9, 10]
    assert next(row["update"] for row in reporter.rows if row["curriculum/buffer_is_stale"]) == 6
    first, recovered = events(ray, "recovered", role="worker")  # one figure a loss
    assert (first["section"], first["from_update"], first["to_update"]) == ("update", 7, 7)
    assert recovered["section"] == "recover" and 0 < recovered["seconds"] < first["seconds"]
    last = reporter.rows[-1]
    assert (last["runtime/restarts_curator"], last["runtime/restarts_worker"]) == (1, 2)
    assert last["runtime/recovery_seconds_worker"] == pytest.approx(recovered["seconds"], abs=0.01)
    record = json.loads((ray / "adoptions.json").read_text())
    assert record["0"] == 0 and (record["3"] is None or record["3"] > 5)
    repeated = tmp_path / "repeated"
    repeated.mkdir()
    shutil.copy(ray / "adoptions.json", repeated)
    _run(tiny_config(num_updates=10, placement="colocated"), repeated, LocalBackend())
    assert_same_bits(final_arrays(repeated), final_arrays(ray))


@pytest.mark.long
def test_a_worker_that_scores_levels_itself_is_killed_over_it_and_nothing_is_lost(ray_backend, local_arrays, tmp_path):
    killed = []

    def kill(number, trainer, curator):
        if number == 5 and not killed:  # before the second refresh is worked out
            killed.append(trainer._handles[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    config, path = tiny_config(num_updates=8, placement="colocated", num_curators=0), tmp_path / "ray"
    _run(config, path, ray_backend, at_update=kill)
    assert [(row["process"], row["section"]) for row in events(path, "process_lost")] == [("worker 0", "curate")]
    assert [(row["policy_version"], row["update"]) for row in events(path, "buffer_adopted")] == [(0, 0), (3, 5)]
    assert_same_bits(final_arrays(path), local_arrays)


@pytest.mark.long
def test_a_fork_server_that_is_stopped_is_replaced(ray_backend, local_arrays, tmp_path, monkeypatch):
    """Every process that starts would wait for it, and count as lost."""
    noted = []
    monkeypatch.setattr(ray_backend, "_on_event", lambda kind, **details: noted.append((kind, details)))
    before = ray_backend._fork_server.pid

    def stop_it(number, trainer, curator):
        if number == 3 and ray_backend._fork_server.pid == before:
            os.kill(before, signal.SIGSTOP)
            os.kill(trainer._handles[0].pid, signal.SIGKILL)

    _run(tiny_config(num_updates=8, placement="colocated"), tmp_path / "ray", ray_backend, at_update=stop_it)
    assert ("fork_server_lost", {"reason": "is stopped"}) in noted
    assert ray_backend._fork_server.pid != before
    assert_same_bits(final_arrays(tmp_path / "ray"), local_arrays)


@pytest.mark.long
@pytest.mark.parametrize(("count", "num_curators"), [(2, 0), pytest.param(3, 1, marks=pytest.mark.slow)])
def test_several_workers_over_gloo_agree_with_one(ray_backend, local_arrays, tmp_path, count, num_curators):
    """Two share the scoring, too. Three of them cannot share the four world groups evenly."""
    config = tiny_config(num_updates=8, placement="colocated", num_workers=count, num_curators=num_curators)
    _run(config, tmp_path / "ray", ray_backend)
    arrays = final_arrays(tmp_path / "ray")
    for name, expected in local_arrays.items():
        if name.startswith("learner/params"):
            # float32 sums in another order, 32 gradient steps of size 1e-3 each: Adam turns a rounding difference
            # of a near-zero gradient into up to a step, so single parameters may differ by a few steps' rounding.
            np.testing.assert_allclose(arrays[name], expected, atol=2e-4, err_msg=name)
        elif name.startswith("curriculum/levels"):
            np.testing.assert_array_equal(arrays[name].shape, expected.shape)
    assert arrays["learner/num_updates"] == 8


@pytest.mark.slow  # test_split.py shows it too, of an actor that is lost with a learner
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
    assert reporter.rows[-1]["runtime/restarts_rollout"] == 1
    (lost,) = events(tmp_path / "ray", "process_lost")
    assert (lost["process"], lost["role"], lost["section"]) == ("rollout 1", "rollout", "update")
    assert len(events(tmp_path / "ray", "recovered", role="rollout")) == 1
    assert_same_bits(final_arrays(tmp_path / "ray"), final_arrays(tmp_path / "local"))


# Parts of a user: an observation, a reward and a curriculum that the system does not know

PLUGINS = ("examples.own_observation", "examples.own_reward", "examples.own_curriculum")


def _config_of_a_user(*, num_updates, **run):
    import_plugins(PLUGINS)
    config = tiny_config(num_updates=num_updates, plugins=PLUGINS, **run)
    return dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, observation="from_green", reward="goal_less_effort", max_steps=5),
        policy=dataclasses.replace(config.policy, network="flat"),
        curriculum=CurriculumConfig(name="most_failed", levels="designed_s"),
    )


def test_parts_of_a_user_are_trained_in_one_process_and_on_ray_alike(ray_backend, tmp_path):
    config = _config_of_a_user(num_updates=6, placement="colocated")
    assert from_dict(to_dict(config)) == config
    _, reporter = _run(config, tmp_path / "local", LocalBackend())
    arrays = final_arrays(tmp_path / "local")
    # It saw the outcome of every level: the episodes it counted are those that were reported.
    assert arrays["curriculum/finished"].sum() == sum(row["train/episodes"] for row in reporter.rows) > 0
    assert reporter.rows[-1]["curriculum/levels_tried"] == 1.0
    assert arrays["learner/num_gradient_steps"] == 6 * config.ppo.epochs * config.ppo.minibatches
    _run(config, tmp_path / "ray", ray_backend)
    assert_same_bits(final_arrays(tmp_path / "ray"), arrays)


@pytest.mark.long
def test_a_curriculum_of_a_user_goes_on_where_its_run_was_cut(tmp_path):
    """Split placement: the batch in flight was proposed by the state before the last one that was seen."""
    run = {"placement": "split", "num_rollout_actors": 2}
    config = _config_of_a_user(num_updates=6, **run)
    _, reporter = _run(config, tmp_path / "whole", LocalBackend())
    arrays = final_arrays(tmp_path / "whole")
    assert arrays["curriculum/finished"].sum() == sum(row["train/episodes"] for row in reporter.rows) > 0
    assert (arrays["proposing/finished"] < arrays["curriculum/finished"]).any()
    _run(_config_of_a_user(num_updates=3, **run), tmp_path / "cut", LocalBackend())
    _run(config, tmp_path / "cut", LocalBackend(), resume=True)
    assert_same_bits(final_arrays(tmp_path / "cut"), arrays)


def test_a_plugin_that_is_not_there_is_named_in_one_line():
    with pytest.raises(PluginError, match=r"module 'no_such_parts' cannot be imported .*PYTHONPATH"):
        from_dict({**to_dict(tiny_config(num_updates=1)), "run": {"plugins": ["no_such_parts"], "total_env_steps": 1}})
