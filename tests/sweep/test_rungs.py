"""Successive halving and the time a sweep takes."""

import pytest

from kinetix_dist.errors import UserError
from kinetix_dist.sweep.arms import runs_of
from kinetix_dist.sweep.rungs import check_fits, num_staying, predicted_seconds, stage_sizes, stages
from tests.sweep.designs import design, halving_text, text


def test_the_better_half_of_the_arms_goes_on(tmp_path):
    halving = design(tmp_path, halving_text())
    areas = {"plain": 0.3, "wide": 0.1, "narrow": 0.4, "slow": 0.2}
    requested = []

    def area_of(run, until):
        requested.append(until)
        return areas[run.arm.name]

    found = list(stages(halving, runs_of(halving), area_of))
    assert [([run.arm.name for run in stage.runs], stage.seconds) for stage in found] == [
        (["plain", "wide", "narrow", "slow"], 20.0),
        (["plain", "narrow"], 40.0),
        (["narrow"], 80.0),
    ]
    assert requested == [20.0] * 4 + [40.0] * 2
    assert [(count, until) for count, until in stage_sizes(halving, 4)] == [(4, 20.0), (2, 40.0), (1, 80.0)]


def test_arms_are_compared_by_their_mean_over_seeds(tmp_path):
    halving = design(tmp_path, halving_text().replace("seeds = [0]", "seeds = [0, 1]"))
    areas = {"plain": (0.9, 0.1), "wide": (0.6, 0.6), "narrow": (0.1, 0.2), "slow": (0.55, 0.55)}
    found = list(stages(halving, runs_of(halving), lambda run, until: areas[run.arm.name][run.seed]))
    assert [run.name for run in found[1].runs] == ["wide-seed0", "slow-seed0", "wide-seed1", "slow-seed1"]


def test_a_share_of_the_arms_is_rounded_up():
    assert [num_staying(count, 0.5) for count in (8, 7, 1)] == [4, 4, 1]
    assert num_staying(10, 0.3) == 3  # 0.3 x 10 is 3.0000000000000004 or less


def test_predicted_time_is_of_waves(tmp_path):
    full = design(tmp_path, text())  # 4 runs of 20 s and 10 s to start
    assert predicted_seconds(full, [0.0] * 4, 1) == 120
    assert predicted_seconds(full, [0.0] * 4, 3) == 60
    assert predicted_seconds(full, [20.0, 20.0, 5.0, 0.0], 2) == 30  # what is done takes no time
    halving = design(tmp_path, halving_text())  # 4 x (10 + 20), 2 x (10 + 20), 1 x (10 + 40)
    assert predicted_seconds(halving, [0.0] * 4, 1) == 120 + 60 + 50
    assert predicted_seconds(halving, [20.0, 40.0, 40.0, 20.0], 1) == 50


@pytest.mark.parametrize(
    ("content", "minutes", "what"),
    [
        (
            text(),
            1.7,
            "4 runs on 1 slot take 2 minutes, and 1.7 are given: 3 runs fit, or all with seconds 10; or give",
        ),
        (text(), 1.0, "2 runs fit; or give --minutes 2 or more slots"),
        (text(), 0.1, "0 runs fit; or give --minutes 2 or more slots"),
        (halving_text(), 3.5, "take 4 minutes, and 3.5 are given: the rungs up to 40 s fit"),
        (halving_text(), 2.0, "the rungs up to 20 s fit"),
        (halving_text(), 1.0, "not even the first rung fits"),
    ],
)
def test_more_than_fits_is_refused_with_what_fits(tmp_path, content, minutes, what):
    sweep = design(tmp_path, content)
    with pytest.raises(UserError, match=what):
        check_fits(sweep, {run.name: 0.0 for run in runs_of(sweep)}, 1, minutes)
    check_fits(sweep, {run.name: 0.0 for run in runs_of(sweep)}, 1, 4.0)


def test_what_is_done_need_not_fit_again(tmp_path):
    sweep = design(tmp_path, text())
    done = {run.name: 20.0 for run in runs_of(sweep)[:3]}
    check_fits(sweep, {run.name: done.get(run.name, 0.0) for run in runs_of(sweep)}, 1, 0.5)
