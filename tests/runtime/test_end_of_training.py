"""Where training ends: at a solve rate, and after seconds with or without the first update, which compiles."""

import dataclasses

import pytest

from kinetix_dist.config import ConfigError
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan
from tests.runtime.runs import QuietReporter, run_updates, tiny_config


def train(path, *, evaluation_every=0, rates=(), **run):
    """Number of updates of a run whose evaluations during training give `rates`, one after another."""
    config = tiny_config(num_updates=6)
    config = dataclasses.replace(
        config,
        evaluation=dataclasses.replace(config.evaluation, every=evaluation_every),
        run=dataclasses.replace(config.run, placement="local", **run),
    )
    backend, reporter = LocalBackend(), QuietReporter()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])
    evaluate, given = trainer.evaluate, iter(rates)

    def evaluated(*, use_policy):
        rate = next(given)
        return {name: {**found, "rate": rate} for name, found in evaluate(use_policy=use_policy).items()}

    trainer.evaluate = evaluated
    return run_updates(config, path, trainer, curator, reporter=reporter).num_updates


def test_a_solve_rate_that_ends_training_needs_evaluations():
    config = tiny_config(num_updates=2)
    with pytest.raises(ConfigError, match=r"run\.stop_at is 0\.9, but evaluation\.every and every_seconds are 0"):
        dataclasses.replace(config, run=dataclasses.replace(config.run, stop_at=0.9))


@pytest.mark.long
def test_training_ends_at_the_first_evaluation_with_the_solve_rate(tmp_path):
    assert train(tmp_path / "run", evaluation_every=1, rates=(0.5, 0.89, 0.9, 1.0), stop_at=0.9) == 3


@pytest.mark.long
def test_seconds_count_the_first_update_or_leave_it_out(tmp_path):
    ends = {"total_env_steps": 0, "max_seconds": 1e-9}
    assert train(tmp_path / "counted", **ends) == 0
    assert train(tmp_path / "left out", **ends, warmup_counts=False) == 1
