"""Rules hold where they should, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.studio.runs.warnings import RULES, SPEED, STABILITY, Rule, warning_statements, warnings_of

# By metric: values of 20 rows with which the rule just holds, and with which it just does not.
CASES = {
    "curriculum/buffer_is_stale": ([0] * 19 + [1], [1] * 19 + [0]),
    "curriculum/learnable_share": ([0.5] * 10 + [0.009] * 10, [0.0] * 10 + [0.011] * 10),
    "learner/skipped_steps": ([1] + [0] * 19, [0] * 20),
    "runtime/dropped_steps": ([0] * 10 + [64] + [0] * 9, [0] * 20),
    "runtime/restarts": ([0] * 10 + [1] * 10, [0] * 20),
    "learner/approx_kl": ([0] * 10 + [0.11] * 10, [1] * 10 + [0.09] * 10),
    "learner/clip_fraction": ([0] * 10 + [0.41] * 10, [1] * 10 + [0.39] * 10),
    "learner/entropy": ([5.0] * 10 + [0.24] * 10, [5.0] * 10 + [0.26] * 10),
    "physics/unstable": ([0.1] + [0] * 19, [0] * 20),
    "time/idle": ([0] * 10 + [0.21] * 10, [1] * 10 + [0.19] * 10),
    "time/curate": ([0] * 10 + [0.11] * 10, [1] * 10 + [0.09] * 10),
    "time/checkpoint": ([0] * 10 + [0.06] * 10, [1] * 10 + [0.04] * 10),
    "memory/host_share": ([0] * 19 + [0.91], [1] * 19 + [0.89]),
    "memory/gpu_share": ([0] * 19 + [0.99], [1] * 19 + [0.97]),
    "telemetry/dropped_rows": ([0] * 19 + [1], [0] * 20),
}


def table_of(metric: str, values: Sequence[float]) -> SeriesTable:
    table = SeriesTable()
    table.append({"update": k + 1, metric: value} for k, value in enumerate(values))
    return table


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.metric)
def test_a_rule_holds_where_it_should(rule: Rule) -> None:
    holds, does_not = CASES[rule.metric]
    (warning,) = warnings_of(table_of(rule.metric, holds))
    assert warning.rule is rule and warning.finding
    assert warnings_of(table_of(rule.metric, does_not)) == []


def test_a_run_without_these_metrics_has_no_warnings() -> None:
    assert warnings_of(table_of("train/episodes", [1.0])) == [] == warnings_of(SeriesTable())


def test_each_warning_is_stated_once_by_the_part_that_it_is_about() -> None:
    rows = {"learner/approx_kl": 0.2, "time/idle": 0.3, "learner/skipped_steps": 1.0}
    table = SeriesTable()
    table.append({"update": update, **rows} for update in range(1, 21))
    warnings = warnings_of(table)
    assert {one.rule.metric: one.rule.part for one in warnings} == {
        "learner/approx_kl": "",
        "time/idle": SPEED,
        "learner/skipped_steps": STABILITY,
    }
    (statement,) = warning_statements(warnings)
    assert statement.title == "learner/approx_kl" and statement.query == {"panel": "learner/approx_kl"}
    assert statement.sentence == "0.2 in the last 10 rows (rule: mean of 10 rows above 0.1)."
    assert "lower ppo.learning_rate" in statement.remedy
    (none,) = warning_statements([])
    assert none.state == "good" and none.sentence == "None."
