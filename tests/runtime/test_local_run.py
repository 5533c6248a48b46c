"""A run in one process: buffers are adopted on time, and a killed run goes on as if nothing had happened."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from kinetix_dist.checkpoint import CheckpointError, list_checkpoints, load_checkpoint, save_checkpoint
from kinetix_dist.config import to_dict
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.program_cache import compile_seconds, count_compile_seconds
from kinetix_dist.runtime.driver import refreshes
from kinetix_dist.runtime.driver.checkpoints import newest_checkpoint
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.refreshes import CuratorClient, WorkerCurator
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.driver.stopping import StoppedError, StopSignals
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan, plan_placement
from kinetix_dist.telemetry.curriculum_log import REFRESH, CurriculumLogConfig, list_snapshots, read_snapshot
from tests.helpers import REPOSITORY
from tests.runtime.runs import (
    QuietReporter,
    assert_same_bits,
    final_arrays,
    run_directory,
    run_updates,
    tiny_config,
)

WORKER = ProcessPlan(role="worker", index=0)
CURATOR = ProcessPlan(role="curator", index=0)


def _run_local(config, path, reporter=None, *, resume=False):
    backend = LocalBackend()
    trainer, curator = ColocatedTrainer(config, backend, [WORKER]), CuratorClient(config, backend, [CURATOR])
    return run_updates(config, path, trainer, curator, reporter=reporter, resume=resume)


@pytest.fixture(scope="module")
def eight_updates(tmp_path_factory):
    """(folder, rows of metrics) of an undisturbed run."""
    path, reporter = tmp_path_factory.mktemp("eight") / "run", QuietReporter()
    _run_local(tiny_config(num_updates=8), path, reporter)
    return path, reporter.rows


@pytest.mark.long
def test_a_buffer_requested_at_update_k_is_used_from_k_plus_adopt_after_on(eight_updates):
    path, rows = eight_updates  # refresh every 3, adopted after 2; the first at once
    events = [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    adopted = [(e["policy_version"], e["update"]) for e in events if e["event"] == "buffer_adopted"]
    assert adopted == [(0, 0), (3, 5)]
    assert [row["curriculum/buffer_age"] for row in rows] == [0, 1, 2, 3, 4, 2, 3, 4]
    assert all(row["runtime/policy_lag"] == 0 for row in rows)


@pytest.mark.long
@pytest.mark.also_gpu
def test_a_worker_that_scores_levels_itself_gives_the_run_that_a_curator_gives(eight_updates, tmp_path):
    config, backend, reporter = tiny_config(num_updates=8, num_curators=0), LocalBackend(), QuietReporter()
    trainer = ColocatedTrainer(config, backend, [WORKER])
    run_updates(config, tmp_path / "run", trainer, WorkerCurator(trainer), reporter=reporter)
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(eight_updates[0]))
    assert [row["curriculum/buffer_age"] for row in reporter.rows] == [0, 1, 2, 3, 4, 2, 3, 4]
    assert all(row["time/curate"] > 0 for row in (reporter.rows[0], reporter.rows[5]))


class _NotingTrainer(ColocatedTrainer):
    """Keeps what it did, in order."""

    def __init__(self, config):
        super().__init__(config, LocalBackend(), [WORKER])
        self.done = []

    def run_update(self, num_updates):
        self.done.append(f"update {num_updates}")
        return super().run_update(num_updates)

    def refresh(self, weights, policy_version, probe, given):
        self.done.append(f"refresh {policy_version}")
        return super().refresh(weights, policy_version, probe, given)


@pytest.mark.long
def test_workers_score_levels_when_they_are_due_so_that_a_resumed_run_makes_an_update_first(eight_updates, tmp_path):
    done = []
    for num_updates in (4, 8):  # the refresh requested at 3 is in flight between them
        config = tiny_config(num_updates=num_updates, num_curators=0)
        trainer = _NotingTrainer(config)
        run_updates(config, tmp_path / "run", trainer, WorkerCurator(trainer), resume=num_updates == 8)
        done.append(trainer.done)
    assert done == [
        ["refresh 0", "update 0", "update 1", "update 2", "update 3"],
        ["update 4", "refresh 3", "update 5", "update 6", "update 7"],
    ]
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(eight_updates[0]))


def _with_refreshes_alike(**run):
    """Without probes, so that the second refresh runs the programs of the first."""
    config = tiny_config(num_curators=0, **run)
    return dataclasses.replace(config, curriculum_log=CurriculumLogConfig(probe_levels=0))


def _stopped_after_five(config, path):
    """Updates done until SIGTERM, which came in the fifth."""
    stop = StopSignals()

    class Signalled(_NotingTrainer):
        def run_update(self, num_updates):
            if num_updates == 4:
                stop.requested = "SIGTERM"
            return super().run_update(num_updates)

    trainer = Signalled(config)
    run = run_directory(path, config, resume=False)
    controller = Controller(
        config, run, Roles(trainer=trainer, curator=WorkerCurator(trainer)), QuietReporter(), stop=stop
    )
    controller.restore(resume=False)
    with pytest.raises(StoppedError, match="stopped by SIGTERM after update 5, which is saved"):
        controller.train()
    controller.close()
    run.close()
    assert trainer.done[:6] == ["refresh 0", *(f"update {update}" for update in range(5))]
    return trainer.done[6:]


@pytest.mark.parametrize("is_quick", [True, False])
def test_a_run_stopped_right_before_a_buffer_is_due_has_it_in_its_checkpoint(
    eight_updates, tmp_path, monkeypatch, is_quick
):
    """The one requested at 3 is due before update 5. Where scoring is slow, a stop does not wait for it."""
    monkeypatch.setattr(refreshes, "MAX_EARLY_S", np.inf if is_quick else 0.0)
    config, path = _with_refreshes_alike(num_updates=8), tmp_path / "run"
    assert _stopped_after_five(config, path) == (["refresh 3"] if is_quick else [])
    _goes_on_as_unbroken(config, path, eight_updates[0], first=["update 5"] if is_quick else ["refresh 3", "update 5"])


@pytest.mark.parametrize("why", ["programs of a new phase", "of a probe", "no update comes"])
def test_a_run_that_is_stopped_scores_no_levels_where_that_would_compile_or_be_in_vain(tmp_path, monkeypatch, why):
    monkeypatch.setattr(refreshes, "MAX_EARLY_S", np.inf)
    config = _with_refreshes_alike(num_updates=5 if why == "no update comes" else 8)
    if why == "of a probe":
        config = dataclasses.replace(config, curriculum_log=CurriculumLogConfig(probe_levels=4))
    elif why == "programs of a new phase":
        phase = PhaseConfig(start=5 * config.rollout.steps_per_update, options={"env.dense_reward_scale": 0.5})
        config = dataclasses.replace(config, phases=(phase,))
    assert _stopped_after_five(config, tmp_path / "run") == []


def test_a_checkpoint_right_before_a_buffer_is_due_has_it(eight_updates, tmp_path, monkeypatch):
    monkeypatch.setattr(refreshes, "MAX_EARLY_S", np.inf)
    config, path = _with_refreshes_alike(num_updates=6, checkpoint_every=5), tmp_path / "run"
    trainer = _NotingTrainer(config)
    run_updates(config, path, trainer, WorkerCurator(trainer))
    assert trainer.done[-3:] == ["update 4", "refresh 3", "update 5"]
    last = list_checkpoints(path / "checkpoints")[-1]
    assert last.name == "00000006"
    shutil.rmtree(last)  # a kill came before it
    _goes_on_as_unbroken(_with_refreshes_alike(num_updates=8), path, eight_updates[0], first=["update 5"])


def _goes_on_as_unbroken(config, path, unbroken, *, first):
    """A run goes on from the checkpoint after 5 of 8 updates with what `first` says."""
    trainer = _NotingTrainer(config)
    run_updates(config, path, trainer, WorkerCurator(trainer), resume=True)
    assert trainer.done == [*first, "update 6", "update 7"]
    assert_same_bits(final_arrays(path), final_arrays(unbroken))
    names = [(kind, number) for kind, number, _ in list_snapshots(path / "curriculum")]
    assert names == [(REFRESH, 0), (REFRESH, 3)]
    for name in ("refresh_00000000.npz", "refresh_00000003.npz"):
        here, there = (read_snapshot(folder / "curriculum" / name) for folder in (path, unbroken))
        for key in ("policy_version", "first_batch", "level_id"):
            np.testing.assert_array_equal(here.arrays[key], there.arrays[key])


def test_a_signal_while_workers_score_the_first_levels_ends_the_run_before_the_first_update(tmp_path):
    """The update may compile for minutes."""
    config, stop = tiny_config(num_updates=8, num_curators=0), StopSignals()

    class Signalled(_NotingTrainer):
        def refresh(self, weights, policy_version, probe, given):
            stop.requested = "SIGTERM"
            return super().refresh(weights, policy_version, probe, given)

    trainer = Signalled(config)
    run = run_directory(tmp_path / "run", config, resume=False)
    controller = Controller(
        config, run, Roles(trainer=trainer, curator=WorkerCurator(trainer)), QuietReporter(), stop=stop
    )
    controller.restore(resume=False)
    with pytest.raises(StoppedError, match="stopped by SIGTERM before the first update"):
        controller.train()
    run.close()
    assert trainer.done == ["refresh 0"]


@pytest.mark.also_gpu
def test_two_updates_have_finite_losses_and_change_the_policy(tmp_path):
    reporter = QuietReporter()
    _run_local(tiny_config(num_updates=2, checkpoint_every=1), tmp_path / "run", reporter)
    assert len(reporter.rows) == 2
    for row in reporter.rows:
        learned = {name: value for name, value in row.items() if name.startswith("learner/")}
        assert {"learner/policy_loss", "learner/value_loss", "learner/entropy"} <= learned.keys()
        assert all(np.isfinite(value) for value in learned.values()), learned
        assert row["learner/skipped_steps"] == 0
    before, after = (load_checkpoint(found).arrays for found in list_checkpoints(tmp_path / "run" / "checkpoints"))
    params = [name for name in after if "params" in name]
    assert params and all(np.isfinite(after[name]).all() for name in params)
    assert any(not np.array_equal(before[name], after[name]) for name in params)


def test_a_run_of_equal_settings_compiles_nothing_in_a_process_that_had_one(eight_updates, tmp_path):
    """Longer, saved at other times, and also after it was cut."""
    count_compile_seconds()
    before = compile_seconds()
    _run_local(tiny_config(num_updates=3, checkpoint_every=3), tmp_path / "run")
    _run_local(tiny_config(num_updates=5), tmp_path / "run", resume=True)
    assert compile_seconds() == before
    jax.jit(lambda x: x + before)(1.0)
    assert compile_seconds() > before  # it counts


def test_shares_of_time_add_up_to_one(eight_updates):
    _, rows = eight_updates
    assert len(rows) == 8
    for row in rows:
        assert sum(value for name, value in row.items() if name.startswith("time/")) == pytest.approx(1.0)


def test_a_run_killed_by_sigkill_and_resumed_equals_an_unbroken_one_bit_for_bit(tmp_path):
    num_updates = 16  # of which it is killed after the sixth
    options = ["--run.total_env_steps", str(tiny_config(num_updates=num_updates).run.total_env_steps)]
    options += ["--evaluation.sets", "s/kick", "--evaluation.min_attempts", "4"]
    command = [sys.executable, "-m", "kinetix_dist.cli.main", "train"]
    killed = tmp_path / "killed"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(
        [*command, "--recipe", "tiny", "--run", str(killed), *options],
        env=environment,
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 300
        while not any(int(path.name) >= 6 for path in list_checkpoints(killed / "checkpoints")):
            assert process.poll() is None, "the run ended before it could be killed"
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    assert not (killed / "report.json").exists()
    saved_at = int(list_checkpoints(killed / "checkpoints")[-1].name)
    assert 0 < saved_at < num_updates
    resumed = subprocess.run(
        [*command, "--run", str(killed), "--resume"],
        env=environment,
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert resumed.returncode == 0, resumed.stderr

    _run_local(tiny_config(num_updates=num_updates), tmp_path / "unbroken")
    assert_same_bits(final_arrays(killed), final_arrays(tmp_path / "unbroken"))
    rows = [json.loads(line) for line in (killed / "metrics" / "metrics.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == list(range(1, num_updates + 1))
    assert json.loads((killed / "report.json").read_text())["policy_updates"] == num_updates


def test_a_refresh_in_flight_is_requested_again_with_the_same_weights(tmp_path):
    config = tiny_config(num_updates=4, checkpoint_every=4)  # requested at 3, adopted at 5
    _run_local(config, tmp_path / "run")
    arrays = final_arrays(tmp_path / "run")
    assert any(name.startswith("pending/") for name in arrays)
    longer = tiny_config(num_updates=7)
    backend = LocalBackend()
    (tmp_path / "run" / "config.json").write_text("{}")
    run = RunDirectory.open_existing(tmp_path / "run")
    controller = Controller(
        longer,
        run,
        Roles(trainer=ColocatedTrainer(longer, backend, [WORKER]), curator=CuratorClient(longer, backend, [CURATOR])),
        QuietReporter(),
    )
    controller.restore(resume=True)
    controller.train()
    run.close()
    _run_local(longer, tmp_path / "unbroken")
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(tmp_path / "unbroken"))


def test_a_checkpoint_of_another_config_is_refused_with_the_field(tmp_path):
    _run_local(tiny_config(num_updates=2), tmp_path / "run")
    other = tiny_config(num_updates=4, seed=1)
    (tmp_path / "run" / "config.json").write_text("{}")
    run = RunDirectory.open_existing(tmp_path / "run")
    backend = LocalBackend()
    controller = Controller(other, run, Roles(trainer=ColocatedTrainer(other, backend, [WORKER])), QuietReporter())
    with pytest.raises(CheckpointError, match=r"another config: run.seed 1 instead of 0"):
        controller.restore(resume=True)
    run.close()


def test_a_checkpoint_of_a_version_with_other_fields_is_refused(tmp_path):
    """Its config reads as ours, since fields that it lacks have defaults; its hash says that it is not."""
    config = tiny_config(num_updates=2)
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    theirs = to_dict(config)
    del theirs["env"]["observation"]
    description = {"config": theirs, "config_hash": "0123456789abcdef", "training_seconds": 1.0}
    save_checkpoint(run.checkpoints, 1, {"learner/num_updates": np.ones(())}, description, keep=1)
    with pytest.raises(CheckpointError, match=r"written by an older version, .* start a new run"):
        newest_checkpoint(run, config, QuietReporter())
    run.close()


def test_split_placement_acts_with_the_policy_of_exactly_one_update_before(tmp_path):
    config = tiny_config(num_updates=6, placement="split", num_rollout_actors=2)
    backend = LocalBackend()
    placement = plan_placement(config, num_gpus=0)
    reporter = QuietReporter()
    trainer = SplitTrainer(config, backend, placement)
    run_updates(
        config, tmp_path / "run", trainer, CuratorClient(config, backend, placement.of("curator")), reporter=reporter
    )
    assert [row["runtime/policy_lag"] for row in reporter.rows] == [0, 1, 1, 1, 1, 1]
    assert reporter.rows[-1]["runtime/dropped_steps"] == 0
    assert json.loads((tmp_path / "run" / "adoptions.json").read_text()) == {"0": 0, "3": 5}  # drawn one update ahead
    _run_local(tiny_config(num_updates=6), tmp_path / "lag0")
    lagged, direct = final_arrays(tmp_path / "run"), final_arrays(tmp_path / "lag0")
    assert any(not np.array_equal(lagged[name], direct[name]) for name in direct)


def _run_split(num_updates, path, *, resume=False, trainer_of=SplitTrainer, stop=None, **run):
    config = tiny_config(num_updates=num_updates, placement="split", num_rollout_actors=2, **run)
    config = dataclasses.replace(config, curriculum_log=CurriculumLogConfig(probe_levels=0))
    backend, placement = LocalBackend(), plan_placement(config, num_gpus=0)
    directory = RunDirectory.open_existing(path) if resume else RunDirectory.create(path, numbered=False)
    directory.write_json(directory.config_path, {})
    curator = CuratorClient(config, backend, placement.of("curator"))
    trainer = trainer_of(config, backend, placement)
    controller = Controller(config, directory, Roles(trainer=trainer, curator=curator), QuietReporter(), stop=stop)
    try:
        controller.restore(resume=resume)
        controller.train()
    finally:
        controller.close()
        directory.close()


@pytest.mark.long
def test_a_resumed_split_run_plays_the_batch_that_was_in_flight_again(tmp_path, monkeypatch):
    """The buffer of the batch after it may have been adopted right before a signal, or right after a checkpoint."""
    monkeypatch.setattr(refreshes, "MAX_EARLY_S", np.inf)
    stop = StopSignals()

    class Signalled(SplitTrainer):
        def adopt(self, parts):
            super().adopt(parts)
            if self.has_adopted:
                stop.requested = "SIGTERM"
            self.has_adopted = True

        has_adopted = False

    _run_split(5, tmp_path / "run")
    with pytest.raises(StoppedError, match="stopped by SIGTERM after update 5, which is saved"):
        _run_split(9, tmp_path / "signalled", trainer_of=Signalled, stop=stop)  # adopted before update 4
    _run_split(6, tmp_path / "killed", checkpoint_every=4)
    shutil.rmtree(list_checkpoints(tmp_path / "killed" / "checkpoints")[-1])
    _run_split(9, tmp_path / "unbroken")
    for name in ("run", "signalled", "killed"):
        _run_split(9, tmp_path / name, resume=True)
        assert_same_bits(final_arrays(tmp_path / name), final_arrays(tmp_path / "unbroken"))
