"""The objective: areas against formulas, and curves from the files of a run."""

import json

import numpy as np
import pytest

from kinetix_dist.sweep.design import Objective
from kinetix_dist.sweep.objective import area, read_curve, score, seconds_so_far

WEIGHTS = Objective(sets={"dev_random_s": 3.0, "dev_designed_s": 1.0}, every_seconds=10.0)
WARMUP_S, SECONDS_AN_UPDATE = 35.0, 2.0


def write_run(path, evaluations, *, num_updates=30, levels=10):
    """A run directory. evaluations: {update: (levels solved of dev_random_s, of dev_designed_s)}, update 0 "before"."""
    (path / "metrics").mkdir(parents=True)
    rows = [
        {
            "update": update,
            "progress/seconds": WARMUP_S + SECONDS_AN_UPDATE * (update - 1),
            "progress/warmup_seconds": WARMUP_S,
        }
        for update in range(1, num_updates + 1)
    ]
    names = [str(index) for index in range(levels)]
    lines = [
        {
            "phase": phase,
            "update": update,
            "env_steps": update,
            "sets": {
                name: {"names": names, "solved": [int(index < count) for index in range(levels)], "attempts": 1}
                for name, count in zip(WEIGHTS.sets, counts)
            },
        }
        for update, counts in evaluations.items()
        for phase in (["random_policy", "before"] if update == 0 else ["training"])
    ]
    (path / "metrics" / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (path / "evaluations.jsonl").write_text("".join(json.dumps(row) + "\n" for row in lines))
    return path


def test_the_area_of_straight_lines_is_that_of_geometry():
    x = np.array([0.0, 10.0, 20.0])
    assert area(x, np.array([0.5, 0.5, 0.5]), 3.0, 17.0) == pytest.approx(0.5)
    assert area(x, np.array([0.0, 1.0, 1.0]), 0.0, 20.0) == pytest.approx(0.75)  # a triangle and a square
    assert area(x, np.array([0.0, 1.0, 1.0]), 5.0, 10.0) == pytest.approx(0.75)  # from .5 to 1


def test_the_area_of_a_smooth_curve_is_its_integral():
    x = np.sort(np.random.default_rng(0).uniform(0, 100, 2000))
    x[0], x[-1] = 0.0, 100.0
    tau = 30.0  # mean of 1 - exp(-x / tau) from 20 to 80
    expected = 1 - tau / 60 * (np.exp(-20 / tau) - np.exp(-80 / tau))
    assert area(x, 1 - np.exp(-x / tau), 20.0, 80.0) == pytest.approx(expected, abs=1e-4)  # 2,000 trapezia


def test_an_area_beyond_the_points_is_refused():
    with pytest.raises(ValueError, match="do not span"):
        area(np.array([0.0, 10.0]), np.zeros(2), 0.0, 11.0)


def test_a_curve_is_over_seconds_without_warm_up_and_weighted(tmp_path):
    run = write_run(tmp_path / "run", {0: (2, 0), 6: (4, 2), 11: (6, 6)})
    curve = read_curve(run, WEIGHTS)
    assert curve.seconds.tolist() == [0.0, 10.0, 20.0]
    assert curve.values == pytest.approx([0.15, 0.35, 0.6])  # (3 x .2 + 0) / 4, (3 x .4 + .2) / 4, .6
    assert seconds_so_far(run) == SECONDS_AN_UPDATE * 29
    assert score(curve, WEIGHTS, 20.0).area == pytest.approx((0.25 + 0.475) / 2)
    assert score(curve, WEIGHTS, 20.0).last == pytest.approx((0.15 + 0.35 + 0.6) / 3)


def test_a_score_until_a_second_does_not_see_what_comes_later(tmp_path):
    short = read_curve(write_run(tmp_path / "short", {0: (2, 0), 6: (4, 2)}), WEIGHTS)
    long = read_curve(write_run(tmp_path / "long", {0: (2, 0), 6: (4, 2), 11: (6, 6), 16: (9, 9)}), WEIGHTS)
    assert score(short, WEIGHTS, 10.0) == score(long, WEIGHTS, 10.0)
    assert not short.reaches(10.1) and long.reaches(30.0)


def test_a_run_that_has_not_begun_has_an_empty_curve(tmp_path):
    curve = read_curve(tmp_path / "nothing", WEIGHTS)
    assert not curve.reaches(0.0) and seconds_so_far(tmp_path / "nothing") == 0.0
    half = write_run(tmp_path / "half", {}, num_updates=1)  # killed before its first evaluation
    assert len(read_curve(half, WEIGHTS).seconds) == 0
