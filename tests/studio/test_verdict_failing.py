"""What fails, by feature: the group that fails most beyond the rest is named, and only where it is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinetix_dist.level.frontier import frontier_sets
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.statements import Statement
from kinetix_dist.studio.runs.verdict_failing import Features, failing_statement
from kinetix_dist.studio.runs.verdict_sets import set_histories
from tests.studio.runs_for_tests import write_config, write_evaluations
from tests.studio.serving import serving

NUM, ATTEMPTS = 60, 4
RANDOM = [f"random_s_{k}" for k in range(NUM)]
JOINTS = [k % 4 for k in range(NUM)]
DRAWN = "frontier_s"  # built by the engine in seconds


def failing(
    run: Path, sets: dict[str, tuple[list[str], list[int]]], features: dict[str, Features], **problems: str
) -> Statement:
    """sets: names of levels, and solved attempts of each now."""
    write_config(run)
    write_evaluations(
        run, {name: (names, ATTEMPTS, [[0] * len(names)] * 2 + [now]) for name, (names, now) in sets.items()}
    )
    (found,) = failing_statement(set_histories(evaluations(run)), features, problems)
    return found


def test_the_group_that_fails_most_beyond_the_rest_is_named_with_its_numbers(tmp_path: Path) -> None:
    solved = [0 if joints == 3 else 3 - (joints == 2) for joints in JOINTS]
    features = {"joints": JOINTS, "shapes": [k // 4 % 3 for k in range(NUM)]}
    found = failing(tmp_path / "a", {"random_s": (RANDOM, solved)}, {"random_s": features})
    assert found.sentence.startswith("Solved in no attempt now: random_s 15 of 60 levels (25.0 %, 4 attempts each). ")
    assert (
        "In random_s, levels with 3 joints fail most beyond the rest: 0.0 % (0 of 60 attempts, 15 levels) are solved, "
        "of all others 66.7 % (120 of 180): 66.7 points less (" in found.sentence
    )
    assert found.query == {"set": "random_s", "sort": "least", "panel": "What fails in random_s", "group": "joints"}


def test_noise_is_called_so_and_a_distance_in_words(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, ATTEMPTS + 1, NUM).tolist()
    found = failing(tmp_path / "a", {"random_s": (RANDOM, noise)}, {"random_s": {"joints": JOINTS}})
    assert found.sentence.endswith("In random_s no feature goes clearly with failing.") and "group" not in found.query
    far = {"distance": [float(k) for k in range(NUM)]}
    found = failing(tmp_path / "b", {"random_s": (RANDOM, [4] * 45 + [0] * 15)}, {"random_s": far})
    assert "levels with green and blue 44.25 to 59.00 m apart fail most" in found.sentence


def test_families_need_no_features_and_the_link_goes_to_the_widest_gap(tmp_path: Path) -> None:
    names = [f"{family}_{k}" for family in ("hop", "drive", "throw") for k in range(20)]
    sets = {"random_s": (RANDOM, [0] * NUM), "mine": (names, [0] * 20 + [4] * 40)}
    found = failing(tmp_path / "a", sets, {}, random_s="the server has no engine")
    assert "In mine, levels of family hop fail most beyond the rest" in found.sentence
    assert "Features of its levels are not known: the server has no engine." in found.sentence
    assert (found.query["set"], found.query["group"]) == ("mine", "family"), "not to the set with the most failures"


def test_without_counts_of_levels_there_is_no_statement() -> None:
    assert failing_statement([]) == []


def test_the_server_asks_the_engine_and_says_where_it_has_none(tmp_path: Path) -> None:
    run = write_config(tmp_path / "run", evaluation={"sets": [DRAWN, "gone"]})
    drawn = [f"{DRAWN}_{index}" for index in frontier_sets()[DRAWN].indices]
    gone = [f"gone_{k}" for k in range(4)]
    sets = {DRAWN: (drawn, 1, [[0] * len(drawn)] * 3), "gone": (gone, 1, [[0] * 4] * 3)}
    write_evaluations(run, sets)
    with serving(tmp_path) as server:
        (first,) = [one for one in server.json("/api/runs/run/verdict")["statements"] if one["key"] == "failing"]
        assert "feature" not in first["sentence"], "it does not wait for the engine"
        for _ in range(2):
            (found,) = server.json("/api/runs/run/verdict/failing")["statements"]
            assert (
                found["key"] == "failing" and f"In {DRAWN} no feature goes clearly with failing." in found["sentence"]
            )
            assert "Features of its levels are not known: " in found["sentence"] and "gone" in found["sentence"]
    with serving(tmp_path, "--no-play") as server:
        (found,) = server.json("/api/runs/run/verdict/failing")["statements"]
    assert found["sentence"].count("the server was started with --no-play") == 1
