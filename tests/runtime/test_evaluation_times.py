"""Evaluations by seconds of training, and the warm-up that these leave out."""

import dataclasses

import jax
import pytest

from kinetix_dist.config import ConfigError, EvaluationConfig, RecordingConfig
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.evaluations import EVALUATE, RECORD, Due
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan
from tests.runtime.runs import QuietReporter, run_updates, tiny_config


def _config(**evaluation):
    tiny = recipe("tiny")
    return dataclasses.replace(tiny, evaluation=dataclasses.replace(tiny.evaluation, **evaluation))


def test_an_evaluation_is_due_at_the_first_update_at_or_after_each_multiple():
    due = Due(_config(every_seconds=10.0))
    seconds = [0.0, 4.0, 9.9, 10.0, 19.0, 31.0, 39.0, 40.5]
    assert [number for number, now in enumerate(seconds) if due.after(number, now)] == [3, 5, 7]  # 20 and 30: one


def test_a_resumed_run_repeats_no_evaluation_of_before():
    due = Due(_config(every_seconds=10.0))
    assert due.after(100, 57.0) == [] and due.after(101, 59.0) == []
    assert due.after(102, 60.0) == [EVALUATE]


def test_what_a_stopped_update_would_have_had_evaluated_is_due_after_the_resume():
    due = Due(_config(every_seconds=10.0))
    due.after(1, 0.0), due.after(2, 7.0)
    again = Due(_config(every_seconds=10.0))
    again.start(due.description())  # saved at update 3, second 14, at which it was stopped
    assert again.after(4, 14.1) == [EVALUATE] and again.after(5, 19.0) == []


def test_recordings_stay_with_updates():
    config = dataclasses.replace(_config(every_seconds=10.0), recording=RecordingConfig(every=2))
    due = Due(config)
    assert [due.after(number, 6.0 * number) for number in (1, 2, 4)] == [[], [EVALUATE, RECORD], [EVALUATE, RECORD]]


def test_updates_and_seconds_at_once_are_refused():
    with pytest.raises(ConfigError, match=r"every 5 and every_seconds 10; set one of them to 0"):
        EvaluationConfig(every=5, every_seconds=10.0)
    with pytest.raises(ConfigError, match=r"every_seconds is -1"):
        EvaluationConfig(every_seconds=-1.0)


@pytest.mark.long
def test_every_session_counts_its_first_update_as_warm_up(tmp_path):
    def train(num_updates, *, resume):
        config = tiny_config(num_updates=num_updates, checkpoint_every=2)
        backend, reporter = LocalBackend(), QuietReporter()
        trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
        curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])
        run_updates(config, tmp_path / "run", trainer, curator, reporter=reporter, resume=resume)
        return [(row["progress/seconds"], row["progress/warmup_seconds"]) for row in reporter.rows]

    first = train(2, resume=False)
    jax.clear_caches()  # as in a process of its own: else its first update takes hardly longer than what comes after it
    second = train(4, resume=True)
    assert 0 < first[0][1] <= first[0][0] < first[1][0] and first[0][1] == first[1][1]
    earlier = first[1][0] - first[1][1]  # seconds after the warm-up, up to the checkpoint
    assert second[0][1] == second[1][1] > first[0][1]  # a warm-up more
    # The first update of the second session adds nothing to them but what comes after it, such as its row of metrics.
    assert earlier <= second[0][0] - second[0][1] < earlier + 0.5 * (second[0][1] - first[0][1])
