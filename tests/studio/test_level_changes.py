"""Changes of evaluated levels: against the last, the first and the best evaluation, with intervals."""

from __future__ import annotations

from pathlib import Path

import pytest

from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.level_changes import policy_points, with_changes
from tests.studio.runs_for_tests import write_config, write_evaluations

NAMES = ["a", "b"]


def changed(tmp_path: Path, solved: list[list[int]], attempts: int = 10) -> dict:
    run = write_config(tmp_path / "run")
    write_evaluations(run, {"s": (NAMES, attempts, solved)})
    return with_changes(evaluations(run))


def test_changes_are_against_the_last_the_first_and_the_best(tmp_path: Path) -> None:
    # Random actions, before, two evaluations, after. Level a was best in the middle, b never.
    found = changed(tmp_path, [[9, 9], [2, 0], [8, 0], [6, 0], [1, 0]])
    changes = found["sets"]["s"]["changes"]
    assert changes["last"]["value"] == [-0.5, 0.0] and changes["last"]["points"] == [3, 3]
    assert changes["first"]["value"] == [-0.1, 0.0] and changes["first"]["points"] == [1, 1]
    assert changes["best"]["value"] == [-0.7, 0.0]
    assert changes["best"]["points"] == [2, 3]  # of equally good ones the newest; random actions never count


def test_intervals_of_changes_are_those_of_newcombe(tmp_path: Path) -> None:
    """56 of 70 less 48 of 80: 0.2, 95 % 0.0524 to 0.3339 (Newcombe 1998, table II, method 10)."""
    run = write_config(tmp_path / "run")
    for update, phase, solved, attempts in ((0, "before", 48, 80), (9, "after", 56, 70)):
        line = f'{{"phase": "{phase}", "update": {update}, "env_steps": 0, "sets": {{"s": '
        line += f'{{"names": ["a"], "solved": [{solved}], "attempts": {attempts}}}}}}}\n'
        with (run / "evaluations.jsonl").open("a") as file:
            file.write(line)
    first = with_changes(evaluations(run))["sets"]["s"]["changes"]["first"]
    assert (first["value"], first["low"], first["high"]) == ([0.2], [0.0524], [0.3339])


def test_every_count_has_its_interval(tmp_path: Path) -> None:
    found = changed(tmp_path, [[0, 0], [3, 10], [4, 9]])
    table = found["intervals"]["10"]
    assert len(table) == 11
    assert table[3] == pytest.approx(wilson_interval(3, 10), abs=5e-5)  # four digits are sent
    assert table[0][0] == 0 and table[10][1] == 1


def test_one_evaluation_of_the_policy_has_no_changes(tmp_path: Path) -> None:
    found = changed(tmp_path, [[0, 0], [3, 10]])
    assert found["sets"]["s"]["changes"] is None
    assert policy_points(found["sets"]["s"]["points"]) == [1]


def test_a_run_without_single_levels_has_its_sets(tmp_path: Path) -> None:
    run = write_config(tmp_path / "run")
    (run / "evaluations.json").write_text('{"before": {"s": {"rate": 0.5, "low": 0.4, "high": 0.6, "attempts": 10}}}')
    found = with_changes(evaluations(run))
    assert found["sets"]["s"]["names"] is None and found["sets"]["s"]["changes"] is None
