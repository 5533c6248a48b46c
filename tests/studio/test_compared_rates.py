"""Held-out solve rates of several runs: curves, random actions, the table, and what is said of runs without them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.evaluation.rate_difference import difference_of_rates
from kinetix_dist.studio.runs.compared_rates import (
    baselines,
    metric_of,
    other_levels,
    policy_points,
    rate_curve,
    set_of,
)
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.series import AxisError, SeriesTable
from kinetix_dist.telemetry.json_lines import utc_seconds
from tests.studio.evaluated_runs import write_evaluated_run, write_evaluation
from tests.studio.runs_for_tests import SECONDS, STEPS, metrics_of, write_config, write_run
from tests.studio.serving import Server, serving

METRIC = "evaluation/random_s/solve_rate"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    runs = tmp_path_factory.mktemp("compared")
    write_evaluated_run(runs / "good", before=1, after=3)
    write_evaluated_run(runs / "twin", before=1, after=4, seed=1)
    other = write_run(runs / "other", 20, run={"seed": 2})
    write_evaluation(other, "before", 0, {"s/kick": [0]})
    write_config(runs / "off", evaluation={"sets": []})
    write_config(runs / "young")
    damaged = write_run(runs / "damaged", 20)
    (damaged / "evaluations.json").write_text("{")
    with serving(runs) as server:
        yield server


def points(path: Path, name: str = "random_s") -> list[dict]:
    return evaluations(path)["sets"][name]["points"]


def table_of(updates: int) -> SeriesTable:
    table = SeriesTable()
    table.append({"update": update, **metrics_of(update)} for update in range(1, updates + 1))
    return table


def test_a_metric_names_its_set() -> None:
    assert metric_of("s/kick") == "evaluation/s/kick/solve_rate" and set_of("evaluation/s/kick/solve_rate") == "s/kick"
    assert set_of("train/solve_rate") is None and set_of("evaluation/solve_rate") is None


def test_a_curve_begins_before_training_and_leaves_random_actions_out(tmp_path: Path) -> None:
    found = points(write_evaluated_run(tmp_path / "a", before=1, after=3))
    curve = rate_curve(found, "env_steps", table_of(20), [])
    np.testing.assert_allclose(curve.x, [0, 10 * STEPS, 20 * STEPS])
    np.testing.assert_allclose(curve.rate, [0.25, 0.5, 0.75])
    assert (curve.low[2], curve.high[2]) == pytest.approx(wilson_interval(24, 32))


@pytest.mark.parametrize(("axis", "expected"), [("updates", [0, 10, 20]), ("seconds", [0, 10 * SECONDS, 20 * SECONDS])])
def test_evaluations_have_a_place_on_each_axis(tmp_path: Path, axis: str, expected: list[float]) -> None:
    found = points(write_evaluated_run(tmp_path / "a", before=1, after=3))
    np.testing.assert_allclose(rate_curve(found, axis, table_of(20), []).x, expected)


def test_the_date_of_an_evaluation_follows_from_rows_and_events(tmp_path: Path) -> None:
    found = points(write_evaluated_run(tmp_path / "a", before=1, after=3))
    start = utc_seconds("2026-01-31T12:00:00Z")
    curve = rate_curve(found, "time", table_of(20), [(0, start)])
    np.testing.assert_allclose(curve.x, [start, start + 10 * SECONDS, start + 20 * SECONDS])
    with pytest.raises(AxisError, match="no event"):
        rate_curve(found, "time", table_of(20), [])


def test_the_last_update_counts_once_and_a_run_that_went_on_has_a_newer_one(tmp_path: Path) -> None:
    run = write_evaluated_run(tmp_path / "a", before=1, after=3)
    write_evaluation(run, "training", 20, {"random_s": [2] * 8})
    assert [(p["phase"], p["update"]) for p in policy_points(points(run))][-2:] == [("training", 10), ("after", 20)]
    write_evaluation(run, "training", 30, {"random_s": [2] * 8})
    assert policy_points(points(run))[-1]["update"] == 30


def test_random_actions_of_the_same_levels_are_put_together() -> None:
    def entry(names: list[str], solved: int) -> dict:
        point = {"phase": "random_policy", "rate": solved / 4, "solved": [solved], "attempts": 4, "episodes": 4}
        return {"names": names, "points": [point]}

    sets = {"a": entry(["x"], 1), "b": entry(["x"], 2), "c": entry(["y"], 4), "d": entry(["x"], 4)}
    configs = {run: {"env": {"frame_skip": 4 if run == "d" else 2}} for run in sets}
    found = baselines(sets, configs)
    assert [(one["runs"], one["solved"], one["episodes"]) for one in found] == [
        (["a", "b"], 3, 8),
        (["c"], 4, 4),
        (["d"], 4, 4),
    ]
    assert found[0]["rate"] == 3 / 8 and (found[0]["low"], found[0]["high"]) == wilson_interval(3, 8)
    (problem,) = other_levels({run: {"s": one} for run, one in sets.items()})
    assert problem == "set s has other levels (1 in a, b, d and 1 in c): these rates are not of the same levels"


def test_solve_rates_of_evaluations_are_shown_at_first(server: Server) -> None:
    found = server.json("/api/compare?runs=good,twin&x=updates&points=21")
    assert found["sets"] == ["random_s"] and list(found["curves"]) == [METRIC] and found["metrics"][0] == METRIC
    curves = found["curves"][METRIC]
    assert curves["runs"]["twin"]["x"] == [0, 10, 20] and curves["runs"]["twin"]["mean"] == [0.25, 0.5, 1.0]
    assert curves["runs"]["twin"]["high"][2] == 1 and curves["runs"]["twin"]["episodes"] == [32, 32, 32]
    (group,) = curves["groups"]
    assert group["center"][-1] == pytest.approx((0.75 + 1) / 2), "mean over seeds"
    assert group["low"][-1] == pytest.approx(0.75) and group["high"][-1] == pytest.approx(1)
    (random,) = curves["baselines"]
    assert (random["runs"], random["solved"], random["episodes"]) == (["good", "twin"], 16, 64)


def test_the_table_has_rates_with_counts_and_gains_with_intervals(server: Server) -> None:
    (row,) = server.json("/api/compare?runs=good")["rows"]
    assert (row["run"], row["curriculum"], row["set"], row["seed"]) == ("good", "sfl", "random_s", 0)
    counts = {name: (row[name]["solved"], row[name]["episodes"]) for name in ("random", "before", "now", "best")}
    assert counts == {"random": (8, 32), "before": (8, 32), "now": (24, 32), "best": (24, 32)}
    assert row["gain_before"] == pytest.approx(difference_of_rates(24, 32, 8, 32)._asdict())
    assert row["gain_random"] == pytest.approx(row["gain_before"])
    assert (row["env_steps"], row["seconds"], row["evaluations"]) == (20 * STEPS, 20 * SECONDS, 2)


def test_runs_without_rates_are_named_with_a_reason(server: Server) -> None:
    found = server.json("/api/compare?runs=good,other,off,young,damaged")
    assert found["sets"] == ["random_s", "s/kick"]
    reasons = {row["run"]: row["reason"] for row in found["rows"]}
    assert reasons["good"] is None and reasons["other"] == "no evaluation since training began"
    assert reasons["off"] == "it evaluates on nothing: evaluation.sets is empty"
    assert reasons["young"] == "no evaluation so far (evaluations.jsonl)"
    assert "evaluations.json is damaged" in reasons["damaged"]
    assert found["curves"][METRIC]["missing"] == {
        "other": "not evaluated on random_s",
        "off": reasons["off"],
        "young": "no evaluation so far (evaluations.jsonl)",
        "damaged": reasons["damaged"],
    }


def test_runs_that_were_never_evaluated_are_compared_by_training(server: Server) -> None:
    found = server.json("/api/compare?runs=off,young")
    assert found["sets"] == [] and list(found["curves"]) == ["train/solve_rate"]
    assert found["curves"]["train/solve_rate"]["missing"] == {
        "off": "no train/solve_rate",
        "young": "no train/solve_rate",
    }


def test_several_metrics_are_answered_at_once(server: Server) -> None:
    found = server.json(f"/api/compare?runs=good&metric={METRIC},learner/entropy")
    assert list(found["curves"]) == [METRIC, "learner/entropy"]
    assert found["curves"]["learner/entropy"]["runs"]["good"]["mean"] == [5.0] * 20


def test_an_older_run_has_rates_without_levels(tmp_path: Path) -> None:
    run = write_run(tmp_path / "old", 20)
    (run / "evaluations.json").write_text(
        '{"before": {"m": {"rate": 0.25, "low": 0.1, "high": 0.5, "attempts": 16}}, '
        '"after": {"m": {"rate": 0.5, "low": 0.3, "high": 0.7, "attempts": 16}}}'
    )
    (run / "report.json").write_text('{"policy_updates": 20, "env_steps": 2560}')
    with serving(run) as server:
        (row,) = server.json("/api/compare?runs=old")["rows"]
    assert (row["now"]["solved"], row["now"]["episodes"], row["random"]) == (8, 16, None)
    assert row["gain_before"] == pytest.approx(difference_of_rates(8, 16, 4, 16)._asdict())
    assert row["gain_random"] is None and row["env_steps"] == 2560
