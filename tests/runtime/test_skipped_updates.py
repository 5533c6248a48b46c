"""Gradients or parameters that are not finite: events, a way back, and no run that ends as if it had learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.runtime.driver.checkpoints import Saver
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.totals import NotFiniteError, SkippedUpdates
from kinetix_dist.runtime.processes.local import LocalBackend, LocalHandle
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.telemetry.json_lines import read_lines
from tests.runtime.conftest import NUM_UPDATES, tiny_options
from tests.runtime.runs import NotingReporter, assert_same_bits, final_arrays, run_updates, tiny_config

OVERFLOWS = ["--ppo.value_coefficient", "1e38"]  # every gradient is infinite


def _events(path, *kinds):
    return [row for row in read_lines(path / "events.jsonl").rows if row["event"] in kinds]


def test_parameters_that_a_fault_made_nan_go_back_to_the_checkpoint_and_the_run_is_the_unbroken_one(
    finished_run, tmp_path
):
    config = tiny_config(num_updates=NUM_UPDATES, max_skipped_updates=1)
    backend = LocalBackend()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])

    def poison(number):
        if number == 3 and not poisoned:
            poisoned.append(number)
            (handle,) = trainer._handles
            assert isinstance(handle, LocalHandle)
            learner = handle.core._learner
            assert learner.state is not None
            params = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), learner.state.params)
            learner.state = dataclasses.replace(learner.state, params=params)

    poisoned = []
    reporter = NotingReporter(poison)
    run_updates(config, tmp_path / "run", trainer, curator, reporter=reporter)
    assert [row["update"] for row in reporter.rows] == [1, 2, 3, 4, 3, 4]
    assert [row["learner/skipped_updates"] for row in reporter.rows] == [0, 0, 0, 1, 1, 1]
    (skipped, back) = _events(tmp_path / "run", "update_skipped", "rolled_back")
    assert (skipped["update"], back["from_update"], back["to_update"]) == (4, 4, 2)
    assert reporter.notes[-1] == "the updates before 4 were skipped: back to the checkpoint of 2"
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(finished_run))


@pytest.mark.long
def test_a_run_that_cannot_learn_does_not_end_with_0(tmp_path, capsys):
    assert main(["train", "--run", str(tmp_path / "all"), *tiny_options(2), *OVERFLOWS]) == 1
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("kinetix-dist: all 2 updates were skipped; no gradient was finite: lower ppo.learning_rate")
    assert [row["update"] for row in _events(tmp_path / "all", "update_skipped")] == [1, 2]


@pytest.mark.slow
def test_where_going_back_does_not_help_the_run_ends(tmp_path):
    config = tiny_config(num_updates=9, max_skipped_updates=2)
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, value_coefficient=1e38))
    backend = LocalBackend()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])
    with pytest.raises(NotFiniteError, match="updates 1 to 2 were skipped, also after going back to the last"):
        run_updates(config, tmp_path / "run", trainer, curator)
    assert [row["update"] for row in _events(tmp_path / "run", "update_skipped")] == [1, 2, 1, 2]
    assert len(_events(tmp_path / "run", "rolled_back")) == 1
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_counting():
    skipped = SkippedUpdates(limit=2)
    assert [skipped.add(steps, num_steps=4) for steps in (0, 4, 1, 4)] == [False, True, False, True]
    assert [skipped.is_new_kind(steps, num_steps=4) for steps in (0, 4, 1, 1)] == [False, False, True, False]
    assert not skipped.must_go_back(4)
    skipped.check_end()
    skipped.add(4, num_steps=4)
    assert skipped.must_go_back(5)  # for 4 and 5
    for number in (3, 4):  # from the checkpoint of 2: these are well, the next ones are not
        skipped.add(0, num_steps=4)
        assert not skipped.must_go_back(number)
    skipped.add(4, num_steps=4)
    skipped.add(4, num_steps=4)
    assert skipped.must_go_back(6)  # later ones than before: another fault
    skipped.add(4, num_steps=4)
    skipped.add(4, num_steps=4)
    with pytest.raises(NotFiniteError, match="updates 5 to 6 were skipped, also after going back"):
        skipped.must_go_back(6)


def test_parameters_that_are_not_finite_are_never_saved(tmp_path):
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    saver = Saver(run, NotingReporter(), keep=1)
    saver.save(2, {"learner/params/kernel": np.asarray([1.0, np.nan], np.float32)}, {})
    saver.wait()
    assert saver.saved_at is None and saver.error == (
        "learner/params/kernel is not finite: nothing could go on from it"
    )
    assert not run.checkpoints.exists()
    saver.save(4, {"learner/params/kernel": np.ones(2, jnp.bfloat16), "curriculum/score": np.asarray([np.nan])}, {})
    saver.close()
    assert saver.saved_at == 4 and saver.error is None
    run.close()
