"""Runs with the curricula beside SFL: cut and resumed in the split placement, to the same bits."""

import dataclasses
import shutil

import numpy as np
import pytest

from kinetix_dist.checkpoint import list_checkpoints
from kinetix_dist.curator.config import CurriculumConfig, PlrConfig
from kinetix_dist.runtime.driver.controller import Controller
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, tiny_config

SAVED_AT, NUM_UPDATES = 3, 5
CURRICULA = {
    "domain_randomization": CurriculumConfig(name="domain_randomization"),
    "plr": CurriculumConfig(name="plr", buffer_size=12),
}


def _train(config, path, *, resume):
    """Rows of metrics."""
    run = RunDirectory.open_existing(path) if resume else RunDirectory.create(path, numbered=False)
    run.write_json(run.config_path, {})
    reporter = QuietReporter()
    trainer = SplitTrainer(config, LocalBackend(), plan(config, num_gpus=0))
    controller = Controller(config, run, trainer, None, reporter)
    controller.restore(resume=resume)
    controller.train()
    run.close()
    return reporter.rows


def _what_was_learned(row):
    return {name: value for name, value in row.items() if name.startswith(("train/", "learner/", "curriculum/"))}


@pytest.mark.parametrize("name", CURRICULA)
def test_a_run_that_goes_on_from_its_middle_equals_an_unbroken_one(name, tmp_path):
    """In the split placement: what was in flight at the checkpoint is played again from the state that proposed it."""
    config = tiny_config(num_updates=NUM_UPDATES, placement="split", checkpoint_every=SAVED_AT)
    env = dataclasses.replace(config.env, max_steps=5)  # so that episodes end within an update of 8 steps
    config = dataclasses.replace(config, env=env, curriculum=CURRICULA[name])
    rows = _train(config, tmp_path / "unbroken", resume=False)
    shutil.copytree(tmp_path / "unbroken", tmp_path / "cut")
    saved, last = list_checkpoints(tmp_path / "cut" / "checkpoints")
    assert int(saved.name) == SAVED_AT
    shutil.rmtree(last)
    resumed = _train(config, tmp_path / "cut", resume=True)
    for ours, theirs in zip(resumed, rows[SAVED_AT:], strict=True):
        np.testing.assert_equal(_what_was_learned(ours), _what_was_learned(theirs))
    assert_same_bits(final_arrays(tmp_path / "cut"), final_arrays(tmp_path / "unbroken"))
    assert all(np.isfinite(row["learner/policy_loss"]) for row in rows)


def test_settings_of_plr_are_part_of_the_hash_of_its_own_runs_alone():
    def hash_of(name, **plr):
        curriculum = CurriculumConfig(name=name, plr=PlrConfig(**plr))
        return dataclasses.replace(tiny_config(num_updates=1), curriculum=curriculum).hash

    assert hash_of("sfl") == hash_of("sfl", staleness=0.5)
    assert hash_of("plr") != hash_of("plr", staleness=0.5)
