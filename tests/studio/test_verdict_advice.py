"""One next step of each verdict: from its evidence, with a command that `kinetix-dist` takes as it stands."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from kinetix_dist.cli.train import parse
from kinetix_dist.config import to_dict
from kinetix_dist.studio.runs.verdict import Verdict
from kinetix_dist.studio.runs.verdict_advice import BOTTLENECKS, OUTCOMES
from kinetix_dist.studio.runs.warnings import RULES, SPEED
from kinetix_dist.telemetry.json_lines import append_line
from tests.studio.runs_for_tests import write_config, write_rows
from tests.studio.test_verdict import verdict
from tests.studio.verdict_runs import (
    WINDOW,
    undecided,
    write_collapsed,
    write_curriculum,
    write_evaluation,
    write_learning,
    write_metrics,
    write_mislabelled,
    write_state,
)


def changed_by(run: Path, found: Verdict) -> dict[str, object]:
    """Fields that the command of a verdict gives other values than the run has; it has to be a command of `train`."""
    program, command, *words = shlex.split(found.next_step.command)
    assert (program, command) == ("kinetix-dist", "train")
    new = json.loads(json.dumps(to_dict(parse(words).config)))
    old = json.loads((run / "config.json").read_text())["config"]
    return {
        f"{section}.{field}": value
        for section, fields in new.items()
        if isinstance(fields, dict)
        for field, value in fields.items()
        if value != old[section][field]
    }


def judged(
    run: Path,
    *rates: float,
    state: str = "finished",
    updates: int = 40,
    metrics: Mapping[str, float] | None = None,
) -> Path:
    """A run with evaluations of random_s, evenly over its updates; random actions solve 0.3."""
    write_config(run)
    write_metrics(run, updates, lambda update: metrics or {})
    write_evaluation(run, "random_policy", 0, {"random_s": 0.3})
    for k, rate in enumerate(rates):
        update = k * updates // max(len(rates) - 1, 1)
        phase = "before" if not k else "after" if k == len(rates) - 1 else "training"
        write_evaluation(run, phase, update, {"random_s": rate})
    write_state(run, state, "training", updates)
    return run


def test_a_run_that_still_rises_goes_on(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a")
    found = verdict(run)
    assert found.outcome == "works"
    assert found.next_step.sentence.startswith("train for longer: solve rates of fresh levels still rise (+")
    assert changed_by(run, found) == {"run.total_env_steps": 2 * 1024}
    write_state(run, "running", "training", 96)
    running = verdict(run).next_step
    assert running.sentence.startswith("let it train: ") and not running.command


def test_a_set_that_rises_over_the_last_half_is_reason_enough(tmp_path: Path) -> None:
    found = verdict(judged(tmp_path / "a", 0.3, 0.4, 0.5, 0.52))
    assert "random_s rose over the last half of the run, too (+12.0 points" in found.next_step.sentence
    found = verdict(judged(tmp_path / "b", 0.3, 0.5, 0.51, 0.5, 0.5))
    assert found.next_step.sentence == "train for longer: it is too short to say whether it has levelled off"


def test_a_run_that_levelled_off_is_sent_to_what_fails(tmp_path: Path) -> None:
    run = judged(tmp_path / "a", 0.3, 0.5, 0.51, 0.5, 0.5)
    write_curriculum(run, 6, undecided, episodes=8, fresh_rate=lambda update: 0.5)
    found = verdict(run).next_step
    assert found.sentence.startswith("it levelled off: look at what still fails")
    assert (found.page, found.query["panel"]) == ("evaluation", "What fails in random_s")


def test_labels_that_do_not_hold_are_scored_more(tmp_path: Path) -> None:
    run = write_mislabelled(tmp_path / "a")
    found = verdict(run)
    steps = json.loads((run / "config.json").read_text())["config"]["curriculum"]["scoring_steps"]
    assert found.outcome == "flawed"
    assert found.next_step.sentence.startswith(
        f"score more, curriculum.scoring_steps {steps} → {2 * steps}: 2.0 episodes"
    )
    assert changed_by(run, found) == {"curriculum.scoring_steps": 2 * steps}
    write_evaluation(run, "after", 97, {"random_s": 0.6})
    works = verdict(run)
    assert works.outcome == "partly" and works.next_step == found.next_step


@pytest.mark.parametrize("metric", BOTTLENECKS)
def test_a_bottleneck_is_named_with_the_setting_that_mends_it(tmp_path: Path, metric: str) -> None:
    run = judged(tmp_path / "a", 0.3, 0.6, metrics={metric: 0.35})
    found = verdict(run)
    option, _ = BOTTLENECKS[metric]
    section, field = option.split(".")
    value = json.loads((run / "config.json").read_text())["config"][section][field]
    assert found.next_step.sentence.startswith(f"mend the bottleneck, {option} {value} → {2 * value}: {metric} 0.35 in")
    assert changed_by(run, found) == {option: 2 * value}


def test_every_warning_about_time_has_a_setting() -> None:
    assert {rule.metric for rule in RULES if rule.part == SPEED} == BOTTLENECKS.keys()


def test_learnability_that_falls_asks_for_more_candidates(tmp_path: Path) -> None:
    """Levels of the second buffer are all learned while it is in use, so that it has less to teach than the first."""
    run = judged(tmp_path / "a", 0.3, 0.6, updates=3 * WINDOW)
    write_curriculum(run, 2, undecided, episodes=24)
    outcomes = run / "curriculum" / "outcomes.jsonl"
    line = json.loads(outcomes.read_text().splitlines()[-1])
    attempts = [96] * len(line["attempts"])
    updates = {"from_update": 2 * WINDOW, "update": 3 * WINDOW}
    append_line(outcomes, line | updates | {"attempts": attempts, "solved": attempts})
    found = verdict(run)
    count = json.loads((run / "config.json").read_text())["config"]["curriculum"]["num_candidates"]
    assert found.next_step.sentence.startswith(
        f"choose levels from more candidates, curriculum.num_candidates {count} → {2 * count}: learnability of the "
        "buffer fell from 0.2"
    )
    assert changed_by(run, found) == {"curriculum.num_candidates": 2 * count}


def test_a_collapse_begins_again_from_before_it_with_smaller_updates(tmp_path: Path) -> None:
    run = write_collapsed(tmp_path / "a")
    for update in (20, 40, 60):
        (run / "checkpoints" / f"{update:08d}").mkdir(parents=True)
    found = verdict(run)
    rate = json.loads((run / "config.json").read_text())["config"]["ppo"]["learning_rate"]
    assert found.outcome == "collapsed"
    assert found.next_step.sentence.startswith(
        f"begin a new run from the checkpoint of update 40 with ppo.learning_rate {rate:g} → {rate / 2:g}: 7 gradient"
    )
    checkpoint = str((run / "checkpoints" / "00000040").resolve())
    assert changed_by(run, found) == {"ppo.learning_rate": rate / 2, "run.start_from": checkpoint}


def test_a_policy_that_hardly_varies_gets_more_entropy(tmp_path: Path) -> None:
    run = judged(tmp_path / "a", 0.3, 0.6, 0.31)
    write_rows(run, 41, 60, **{"learner/entropy": 0.001})
    found = verdict(run)
    assert found.outcome == "collapsed" and changed_by(run, found).keys() == {"ppo.entropy_coefficient"}
    write_rows(run, 61, 62, **{"learner/entropy": 0.001, "learner/approx_kl": 0.7})
    found = verdict(run)
    assert "an update moved the policy by 0.7 nat" in found.next_step.sentence
    rate = json.loads((run / "config.json").read_text())["config"]["ppo"]["learning_rate"]
    assert changed_by(run, found) == {"ppo.learning_rate": rate / 2}, "entropy fell by that"
    write_rows(run, 63, 64, **{"learner/entropy": 0.001, "learner/approx_kl": 70.0})
    assert changed_by(run, verdict(run)) == {"ppo.learning_rate": rate / 10}


def test_a_loss_without_a_gain_gets_smaller_updates_or_nearer_levels(tmp_path: Path) -> None:
    run = judged(tmp_path / "a", 0.4, 0.33, metrics={"learner/approx_kl": 0.3})
    found = verdict(run)
    assert found.outcome == "worse" and "learner/approx_kl 0.3 in the last 10 rows" in found.next_step.sentence
    assert changed_by(run, found).keys() == {"ppo.learning_rate"}
    run = judged(tmp_path / "b", 0.4, 0.33)
    write_curriculum(run, 6, undecided, episodes=8, fresh_rate=lambda update: 0.3 + 0.002 * update)
    assert verdict(run).next_step.sentence.startswith("train on levels nearer to random_s (curriculum.generator")


def test_no_change_is_told_by_more_attempts_or_larger_updates(tmp_path: Path) -> None:
    found = verdict(run := judged(tmp_path / "a", 0.3, 0.305))
    assert found.outcome == "unclear" and "may have gained up to" in found.next_step.sentence
    assert changed_by(run, found).keys() == {"evaluation.attempts"}
    found = verdict(run := judged(tmp_path / "b", 0.3, 0.305, metrics={"learner/approx_kl": 0.001}))
    assert "0.001 nat (learner/approx_kl), which is little" in found.next_step.sentence
    assert changed_by(run, found).keys() == {"ppo.learning_rate"}


def test_what_is_too_early_to_tell_says_what_to_wait_for(tmp_path: Path) -> None:
    def early(name: str, **evaluation: float) -> Path:
        run = write_config(tmp_path / name, evaluation={"sets": ["random_s"]} | evaluation)
        write_evaluation(run, "before", 0, {"random_s": 0.3})
        write_state(run, "running", "training", 5)
        return run

    assert verdict(early("new")).next_step.sentence.startswith("wait for the first update")
    write_rows(run := early("every", every=8), 1, 5)
    assert "wait for the evaluation at update 8 (evaluation.every 8)" in verdict(run).next_step.sentence
    write_rows(run := early("never", every=0), 1, 5)
    found = verdict(run)
    assert found.next_step.sentence.startswith("stop it") and changed_by(run, found) == {"evaluation.every": 20}
    write_state(run, "finished", "done", 5)
    assert changed_by(run, verdict(run)).keys() == {"run.total_env_steps"}


def test_a_run_that_failed_goes_on_where_it_has_a_checkpoint(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a")
    write_state(run, "failed", "training", 96, error="the disk is full")
    found = verdict(run)
    assert found.outcome == "failed" and not found.next_step.command
    assert (
        found.next_step.sentence
        == "mend what ended it (the disk is full), then begin again: it has saved no checkpoint"
    )
    (run / "checkpoints" / "00000040").mkdir(parents=True)
    found = verdict(run)
    assert found.next_step.sentence.endswith("then go on from its last checkpoint")
    assert changed_by(run, found) == {}


@pytest.mark.parametrize("write", [write_learning, write_mislabelled, write_collapsed])
def test_without_a_configuration_settings_are_named_without_values(tmp_path: Path, write: Callable[..., Path]) -> None:
    run = write(tmp_path / "a", refreshes=2)
    (run / "config.json").write_text("{}")
    found = verdict(run)
    assert found.outcome in OUTCOMES and found.next_step.sentence and "--recipe" not in found.next_step.command
