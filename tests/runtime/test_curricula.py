"""Runs with curricula other than SFL: cut and resumed in the split placement, to the same bits."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from kinetix_dist.checkpoint import list_checkpoints, load_checkpoint, newest_good
from kinetix_dist.curator.config import CurriculumConfig, PairedConfig, PlrConfig, SlicesConfig
from kinetix_dist.curator.teacher import teacher_levels
from kinetix_dist.learner.step_size import GUARD_FACTOR
from kinetix_dist.level.level import SIZES
from kinetix_dist.runtime.cores.rollout_core import Batch, worlds_trained
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan_placement
from kinetix_dist.telemetry.curriculum_log import list_snapshots, read_snapshot
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, tiny_config

SAVED_AT, NUM_UPDATES = 3, 5
CURRICULA = {
    "domain_randomization": CurriculumConfig(name="domain_randomization"),
    "plr": CurriculumConfig(name="plr", buffer_size=12),
    "robust_plr": CurriculumConfig(name="robust_plr", buffer_size=12),
    "accel": CurriculumConfig(name="accel", buffer_size=12),
    "paired": CurriculumConfig(name="paired", paired=PairedConfig(hidden_size=16, epochs=2)),
    # A refresh is in flight at the checkpoint: requested after update 2, adopted after 4.
    "sfl_slices": CurriculumConfig(
        name="sfl_slices",
        num_candidates=8,
        scoring_batch=2,
        buffer_size=8,
        refresh_every=2,
        adopt_after=2,
        slices=SlicesConfig(slice_size=2, num_harvested=2, attempts=(2, 4), keep_one_of=(2,), window=2),
    ),
}
STUDENTS = ("learner/params/", "curriculum/antagonist/params/")
# One that keeps as much as any, whose learner is compiled for other tests too; and the one with a curator.
MARKS = {"plr": [], "sfl_slices": pytest.mark.long}


def _config(name, **run):
    config = tiny_config(num_updates=NUM_UPDATES, **run)
    # So that episodes end within an update of 8 steps; in "sfl_slices" some are solved by then, of 2.7 s.
    env = dataclasses.replace(config.env, max_steps=5, frame_skip=32 if name == "sfl_slices" else 2)
    return dataclasses.replace(config, env=env, curriculum=CURRICULA[name])


def _train(config, path, *, resume):
    """Rows of metrics."""
    run = RunDirectory.open_existing(path) if resume else RunDirectory.create(path, numbered=False)
    run.write_json(run.config_path, {})
    reporter = QuietReporter()
    backend, placement = LocalBackend(), plan_placement(config, num_gpus=0)
    curator = CuratorClient(config, backend, placement.of("curator")) if config.has_curator else None
    controller = Controller(
        config, run, Roles(trainer=SplitTrainer(config, backend, placement), curator=curator), reporter
    )
    controller.restore(resume=resume)
    controller.train()
    run.close()
    return reporter.rows


def _what_was_learned(row):
    learned = {name: value for name, value in row.items() if name.startswith(("train/", "learner/", "curriculum/"))}
    learned.pop("curriculum/scoring_seconds", None)
    return learned


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, pytest.mark.slow)) for name in CURRICULA])
def test_a_run_that_goes_on_from_its_middle_equals_an_unbroken_one(name, tmp_path):
    """Split placement: the batch in flight at the checkpoint is played again from the state that proposed it."""
    config = _config(name, placement="split", checkpoint_every=SAVED_AT)
    rows = _train(config, tmp_path / "unbroken", resume=False)
    shutil.copytree(tmp_path / "unbroken", tmp_path / "cut")
    saved, last = list_checkpoints(tmp_path / "cut" / "checkpoints")
    assert int(saved.name) == SAVED_AT
    shutil.rmtree(last)
    resumed = _train(config, tmp_path / "cut", resume=True)
    for ours, theirs in zip(resumed, rows[SAVED_AT:], strict=True):
        np.testing.assert_equal(_what_was_learned(ours), _what_was_learned(theirs))
    assert_same_bits(final_arrays(tmp_path / "cut"), final_arrays(tmp_path / "unbroken"))
    after = final_arrays(tmp_path / "cut")
    if name in ("plr", "robust_plr", "accel"):
        assert (after["curriculum/born"] > 0).any()  # of updates after the first
    if name == "sfl_slices":
        assert load_checkpoint(saved).arrays["pending_input/count"] >= 2  # a batch of them
        assert set(after["curriculum/policy_version"]) == {0, 2} and (after["curriculum/num_plays"] > 0).any()
        snapshots = [read_snapshot(path) for _, _, path in list_snapshots(tmp_path / "cut" / "curriculum")]
        levels = {(snapshot.kind, snapshot.number): len(snapshot.arrays["level_id"]) for snapshot in snapshots}
        assert levels == {("refresh", 0): 8, ("refresh", 2): 2, ("buffer", 3): 8, ("buffer", 5): 8}
    if name == "paired":
        assert after["curriculum/teacher/num_updates"] == after["curriculum/antagonist/num_updates"] == NUM_UPDATES
        checkpoint, _ = newest_good(tmp_path / "cut" / "checkpoints")
        assert checkpoint is not None
        builds = teacher_levels(checkpoint, config.curriculum, SIZES[config.env.size]).generate(jax.random.key(0), 2)
        assert np.isfinite(builds.position).all()
        ours, theirs = ({part: after[part] for part in after if part.startswith(whose)} for whose in STUDENTS)
        assert len(ours) == len(theirs) > 0
        assert not any(np.array_equal(a, b) for a, b in zip(ours.values(), theirs.values(), strict=True))
    # Annealing goes by the steps of the run, also where the policy learns from a part of them (`tiny` has it on).
    steps = [0, *(row["progress/env_steps"] for row in rows)]
    for agent in ("learner", "curriculum/antagonist", "curriculum/teacher") if name == "paired" else ("learner",):
        assert after[f"{agent}/env_steps"].tolist() == [steps[-2], 0]
    anneal, ppo = config.ppo.anneal, config.ppo
    share = np.clip((np.array(steps[:-1]) - anneal.start) / (anneal.end - anneal.start), 0, 1)
    assert share.max() > 0.2
    expected = ppo.learning_rate * (1 + (anneal.learning_rate - 1) * share)
    found = np.array([row["learner/learning_rate"] for row in rows])
    guard = np.round(np.log(found / expected) / np.log(GUARD_FACTOR))  # how often it has acted
    assert (np.diff(guard) >= 0).all()
    np.testing.assert_allclose(found, expected * GUARD_FACTOR**guard, rtol=1e-5)
    assert all(np.isfinite(row["learner/policy_loss"]) for row in rows)


def test_settings_of_plr_are_part_of_the_hash_of_its_own_runs_alone():
    def hash_of(name, **plr):
        curriculum = CurriculumConfig(name=name, plr=PlrConfig(**plr))
        return dataclasses.replace(tiny_config(num_updates=1), curriculum=curriculum).hash

    assert hash_of("sfl") == hash_of("sfl", staleness=0.5)
    assert hash_of("plr") != hash_of("plr", staleness=0.5)


def test_the_learner_gets_the_first_worlds_of_each_group_where_a_curriculum_says_so():
    """Robust PLR: two groups of 4 worlds, half of them of the buffer."""
    assert _config("robust_plr").num_trained_envs * 2 == _config("plr").num_trained_envs == 16
    world = np.arange(8)
    batch = worlds_trained(Batch({"static": world}, {"step": world + np.array([[0], [100]])}, world), 2, 2)
    trained = np.array([0, 1, 4, 5])
    np.testing.assert_array_equal(batch.static["static"], trained)
    np.testing.assert_array_equal(batch.trajectory["step"], [trained, trained + 100])
    np.testing.assert_array_equal(batch.last_value, trained)
