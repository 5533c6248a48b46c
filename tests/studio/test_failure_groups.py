"""Groups of failing levels: what explains comes first, noise is not called clear, intervals over levels."""

from __future__ import annotations

import numpy as np
import pytest

from kinetix_dist.evaluation.intervals import interval_over_levels
from kinetix_dist.studio.runs.failure_groups import OTHER_NAMES, SolvedLevels, failure_groups, families_of


def levels_of(solved: list[int], attempts: int = 10) -> SolvedLevels:
    names = tuple(f"level_{k}" for k in range(len(solved)))
    return SolvedLevels(solved=tuple(solved), attempts=attempts, base_levels=names)


def test_a_feature_that_decides_comes_first_with_its_counts() -> None:
    # 20 levels with 2 thrusters: 1 of 10 attempts; 20 without: 9 of 10. Joints alternate, whatever the rate.
    solved = [1] * 20 + [9] * 20
    features = {"joints": [0, 1] * 20, "thrusters": [2] * 20 + [0] * 20}
    found = failure_groups(levels_of(solved), features, ["x"] * 40)
    assert [one["feature"] for one in found] == ["thrusters", "joints"]
    assert [one["is_clear"] for one in found] == [True, False]
    assert found[0]["explained"] == pytest.approx(1.0)
    [with_thrusters] = [group for group in found[0]["groups"] if group["label"] == "2 thrusters"]
    assert (with_thrusters["solved"], with_thrusters["attempts"], with_thrusters["levels"]) == (20, 200, [*range(20)])
    assert (with_thrusters["others"]["solved"], with_thrusters["others"]["attempts"]) == (180, 200)
    assert with_thrusters["difference"]["value"] == pytest.approx(-0.8)
    assert with_thrusters["difference"]["high"] < -0.4
    assert [group["label"] for group in found[1]["groups"]] == ["0 joints", "1 joint"]


def test_the_interval_of_a_group_is_over_its_levels_not_its_attempts() -> None:
    solved = [0, 10, 0, 10, 0, 10, 5, 5]
    found = failure_groups(levels_of(solved), {"joints": [0] * 4 + [1] * 4}, ["x"] * 8)
    group = found[0]["groups"][0]
    expected = interval_over_levels(solved[:4], 10, [f"level_{k}" for k in range(4)])
    assert expected is not None
    assert (group["low"], group["high"]) == (expected["low"], expected["high"])
    assert not group["is_clear"]


def test_noise_is_seldom_called_clear() -> None:
    """Levels whose rates have nothing to do with their features: in at most 5 % of the sets one group is clear."""
    rng = np.random.default_rng(1)
    num_sets = 200
    wrong = 0
    for _ in range(num_sets):
        skill = rng.beta(0.5, 0.5, 64)
        solved = rng.binomial(8, skill).tolist()
        features = {
            "joints": rng.integers(0, 4, 64).tolist(),
            "thrusters": rng.integers(0, 3, 64).tolist(),
            "distance": rng.random(64).tolist(),
        }
        found = failure_groups(levels_of(solved, 8), features, ["x"] * 64)
        assert len(found) == 3
        wrong += any(one["is_clear"] for one in found)
    assert wrong <= 0.05 * num_sets + 2 * (0.05 * 0.95 * num_sets) ** 0.5  # two standard errors of 5 %


def test_noise_explains_nothing_on_average() -> None:
    rng = np.random.default_rng(2)
    features = {"joints": rng.integers(0, 4, 64).tolist()}
    shares = [
        failure_groups(levels_of(rng.integers(0, 9, 64).tolist(), 8), features, ["x"] * 64)[0]["explained"]
        for _ in range(100)
    ]
    assert np.mean(shares) < 0.03  # omega squared is unbiased, cut at 0; without its correction: 3 / 63 = 0.05


def test_rare_counts_are_put_together_and_labels_say_so() -> None:
    joints = [0] * 10 + [1] * 10 + [2] * 10 + [3] * 10 + [4] * 10 + [5] + [9]
    found = failure_groups(levels_of([*range(10)] * 5 + [0, 0]), {"joints": joints}, ["x"] * 52)
    labels = [group["label"] for group in found[0]["groups"]]
    assert labels == ["0 joints", "1 joint", "2 joints", "3 joints", "4 or more joints"]
    assert sum(len(group["levels"]) for group in found[0]["groups"]) == 52
    few_first = failure_groups(levels_of([0, *[5] * 40]), {"fixed_shapes": [0, *[1] * 20, *[2] * 20]}, ["x"] * 41)
    assert [group["label"] for group in few_first[0]["groups"]] == ["up to 1 fixed shape", "2 fixed shapes"]


def test_distances_make_groups_of_as_many_levels() -> None:
    found = failure_groups(levels_of([*range(10)] * 2), {"distance": [k / 10 for k in range(20)]}, ["x"] * 20)
    assert [len(group["levels"]) for group in found[0]["groups"]] == [5, 5, 5, 5]
    assert found[0]["groups"][0]["label"] == "0.00 to 0.47 m"


def test_features_that_divide_alike_are_one_grouping() -> None:
    joints = [0, 1] * 10
    found = failure_groups(levels_of([*range(10)] * 2), {"joints": joints, "motors": joints}, ["x"] * 20)
    assert [(one["feature"], one["same"]) for one in found] == [("joints", ["motors"])]


def test_features_that_all_levels_share_make_no_grouping() -> None:
    assert failure_groups(levels_of([1] * 10), {"joints": [1] * 10, "distance": [2.0] * 10}, ["x"] * 10) == []


def test_levels_that_all_have_the_same_rate_have_nothing_to_explain() -> None:
    found = failure_groups(levels_of([0] * 20), {"joints": [0, 1] * 10}, ["x"] * 20)
    assert found[0]["explained"] == 0.0 and not found[0]["is_clear"]


def test_families_are_base_levels_or_the_beginning_of_names() -> None:
    names = ["hop_home", "hop_far", "kick"]
    assert families_of(names, names) == ["hop", "hop", OTHER_NAMES]
    variants = ["hop_home_0", "hop_home_1", "kick_0", "kick_1"]
    assert families_of(variants, ["hop_home", "hop_home", "kick", "kick"]) == ["hop_home"] * 2 + ["kick"] * 2
