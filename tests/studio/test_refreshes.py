"""Refreshes, training and the history of a level, against counts by hand and plain loops over made-up levels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kinetix_dist.evaluation.learnability import plug_in_learnability
from kinetix_dist.studio.runs.refreshes import (
    Refreshes,
    counts_table,
    histogram_of_p,
    rate_over_levels,
    rates_by_feature,
    training_plays,
)
from kinetix_dist.studio.runs.snapshot_levels import LevelQueryError, level_history, level_page
from kinetix_dist.telemetry.curriculum_log import BUFFER, DIRECTORY, OUTCOMES, REFRESH, write_snapshot
from kinetix_dist.telemetry.json_lines import append_line

FEATURES = ("shapes", "joints")
NUM_CANDIDATES = 40


def write_refresh(run: Path, version: int, chance: np.random.Generator, *, probe_of: int | None = None) -> dict:
    """8 of 40 candidates, those with the highest claimed learnability, as docs/run_data.md has them."""
    finished = chance.integers(0, 4, NUM_CANDIDATES).astype(np.int32)
    solved = chance.binomial(finished, 0.5).astype(np.int32)
    features = chance.integers(0, 3, (NUM_CANDIDATES, 2)).astype(np.uint8)
    score = plug_in_learnability(solved, finished).astype(np.float32)
    chosen = np.argsort(-score, kind="stable")[:8]
    arrays = {
        "curriculum": np.str_("sfl"), "size": np.str_("s"), "policy_version": np.int32(version),
        "written_after": np.int32(version + 2), "first_batch": np.int32(version + 2),
        "scoring_seconds": np.float64(1.5), "level_id": (1000 * version + chosen).astype(np.uint64),
        "score": score[chosen], "features": features[chosen], "feature_names": np.array(FEATURES),
        "candidate": chosen.astype(np.int32), "solved": solved[chosen], "finished": finished[chosen],
        "candidates/solved": solved, "candidates/finished": finished, "candidates/features": features,
        "levels/position": chance.normal(size=(8, 3)),
    }  # fmt: skip
    if probe_of is not None:
        arrays |= {
            "probe/policy_version": np.int32(probe_of),
            "probe/index": np.array([0, 1, 5], np.int32),
            "probe/solved": np.array([4, 0, 2], np.int32),
            "probe/finished": np.array([4, 4, 4], np.int32),
        }
    (run / DIRECTORY).mkdir(parents=True, exist_ok=True)
    write_snapshot(run / DIRECTORY, REFRESH, version, arrays)
    return arrays


def window(buffer: int, first: int, last: int, solved: list[int], attempts: list[int]) -> dict:
    return {
        "format": 2, "update": last, "from_update": first, "buffer": buffer, "solved": solved,
        "attempts": attempts, "sources": {"fresh": {"solved": 3, "attempts": 10}},
    }  # fmt: skip


@pytest.fixture
def run(tmp_path: Path) -> Path:
    chance = np.random.default_rng(0)
    write_refresh(tmp_path, 0, chance)
    write_refresh(tmp_path, 16, chance, probe_of=0)
    append_line(tmp_path / DIRECTORY / OUTCOMES, window(0, 2, 10, [1] * 8, [2] * 8))
    append_line(tmp_path / DIRECTORY / OUTCOMES, window(0, 10, 18, [0, 1] * 4, [1] * 8))
    return tmp_path


def test_counts_and_histograms_by_hand() -> None:
    solved, finished = np.array([0, 0, 1, 2, 1, 0]), np.array([2, 2, 2, 2, 3, 0])
    assert counts_table(solved, finished) == [[0, 0, 1], [0, 2, 2], [1, 2, 1], [1, 3, 1], [2, 2, 1]]
    histogram = histogram_of_p(solved, finished)
    assert histogram[0] == 2 and histogram[-1] == 1 and histogram[1 + 3] == 1 and histogram[1 + 5] == 1
    assert sum(histogram) == 5, "a level that finished no episode has no p"


def test_rates_by_feature_against_a_loop() -> None:
    chance = np.random.default_rng(3)
    features = chance.integers(0, 4, (200, 2)).astype(np.uint8)
    finished = chance.integers(0, 5, 200)
    solved = chance.binomial(finished, 0.4)
    found = rates_by_feature(FEATURES, features, solved, finished)
    for column, name in enumerate(FEATURES):
        for entry in found[name]:
            rows = [k for k in range(200) if features[k, column] == entry["value"]]
            played = [k for k in rows if finished[k]]
            assert entry["levels"] == len(played)
            assert entry["solved"] == sum(int(solved[k]) for k in rows)
            assert entry["episodes"] == sum(int(finished[k]) for k in rows)
            assert entry["rate"] == pytest.approx(sum(solved[k] / finished[k] for k in played) / len(played))


def test_rates_of_scored_levels_are_means_over_levels_not_of_all_their_episodes() -> None:
    """Levels of p = 1/2, a solved episode of 1 step, others of 4, in 8 steps: 59.5 % of all episodes are solved."""
    chance = np.random.default_rng(7)
    solved, finished = np.zeros(4000, int), np.zeros(4000, int)
    for level in range(len(solved)):
        steps_left, length = 8, 0
        while (length := 1 if (is_solved := chance.random() < 0.5) else 4) <= steps_left:
            steps_left, finished[level], solved[level] = (
                steps_left - length,
                finished[level] + 1,
                solved[level] + is_solved,
            )
    assert solved.sum() / finished.sum() > 0.57
    found = rate_over_levels(solved, finished)
    assert found["low"] <= 0.5 <= found["high"] and found["high"] - found["low"] < 0.04
    nothing = rate_over_levels(np.zeros(2, int), np.zeros(2, int))
    assert nothing["rate"] is None and nothing["levels"] == 0


def test_a_level_that_is_played_twice_counts_once(tmp_path: Path) -> None:
    write_refresh(tmp_path, 0, np.random.default_rng(0))
    twice = {"index": [0, 0, 1, 1], "solved": [4, 4, 1, 1], "finished": [4] * 4}
    probe = {f"probe/{name}": np.array(values, np.int32) for name, values in twice.items()}
    arrays = write_refresh(tmp_path, 16, np.random.default_rng(1), probe_of=0)
    write_snapshot(tmp_path / DIRECTORY, REFRESH, 16, arrays | probe)
    first, _ = Refreshes(tmp_path).summaries()["snapshots"]
    assert first["probe"]["levels"] == 2
    assert (first["probe"]["after"]["solved"], first["probe"]["after"]["episodes"]) == (5, 8)


def test_a_run_is_summed_up_with_counts(run: Path) -> None:
    found = Refreshes(run).summaries()
    first, second = found["snapshots"]
    assert found["problems"] == [] and (first["number"], second["number"]) == (0, 16)
    assert first["buffer"]["levels"] == 8 and first["candidates"]["levels"] == NUM_CANDIDATES
    assert first["training"]["solved"] == 8 + 4 and first["training"]["episodes"] == 16 + 8
    assert (first["training"]["from_update"], first["training"]["update"]) == (2, 18)
    # Levels 0, 2, 4, 6: 1 of 3; the others 2 of 3. s (f - s) / (f (f - 1)) is 1/3 for both.
    assert first["training"]["learnability"] == pytest.approx(1 / 3)
    assert first["probe"]["after"]["solved"] == 6 and first["probe"]["levels"] == 3
    assert sum(levels for _, _, levels in first["probe"]["moves"]) == 3
    assert "training" not in second and "probe" not in second
    assert second["retained"] == 0, "plain SFL draws all levels afresh"
    assert found["windows"][0]["sources"]["buffer"]["episodes"] == 16
    assert found["windows"][0]["sources"]["fresh"]["rate"] == 0.3


def test_windows_of_a_buffer_are_added_up() -> None:
    plays = training_plays([window(0, 0, 4, [1, 0], [2, 2]), window(0, 4, 8, [1, 1], [1, 1]), {"no": "buffer"}])
    assert plays[0].solved.tolist() == [2, 1] and plays[0].attempts.tolist() == [3, 3] and plays[0].update == 8


def test_lines_of_another_format_and_lines_without_their_fields_count_as_damaged(tmp_path: Path) -> None:
    write_refresh(tmp_path, 0, np.random.default_rng(0))
    line = window(0, 18, 20, [1] * 8, [2] * 8)
    without = {name: value for name, value in line.items() if name != "attempts"}
    for row in (line | {"format": 1}, without, line):
        append_line(tmp_path / DIRECTORY / OUTCOMES, row)
    found = Refreshes(tmp_path).summaries()
    assert found["problems"] == [f"2 lines are damaged in {DIRECTORY}/{OUTCOMES} and left out"]
    assert found["snapshots"][0]["training"]["episodes"] == 16


def test_what_fresh_levels_offer_is_said_of_candidates_that_are_a_sample_with_two_episodes_each(tmp_path: Path) -> None:
    arrays = write_refresh(tmp_path, 0, np.random.default_rng(0))
    solved, finished = np.array([0, 1, 2, 2] * 10, np.int32), np.array([2, 2, 2, 4] * 10, np.int32)

    def candidates(**changed: np.ndarray | np.str_) -> dict:
        counts = {"candidates/solved": solved, "candidates/finished": finished}
        write_snapshot(tmp_path / DIRECTORY, REFRESH, 0, arrays | counts | changed)
        return Refreshes(tmp_path).summaries()["snapshots"][0]

    fresh = candidates()["candidates"]
    assert fresh["learnability"] == pytest.approx((0 + 1 / 2 + 0 + 1 / 3) / 4)
    few = {"candidates/finished": finished - 1, "candidates/solved": solved // 2}
    assert candidates(**few)["candidates"]["learnability"] is None
    slices = candidates(curriculum=np.str_("sfl_slices"))
    assert slices["candidates"]["learnability"] is None and not slices["is_sample"]


@pytest.mark.parametrize("damage", ["cut", "garbage", "empty", "format"])
def test_a_damaged_snapshot_is_one_line_and_the_others_stay(run: Path, damage: str) -> None:
    path = run / DIRECTORY / "refresh_00000016.npz"
    content = path.read_bytes()
    path.write_bytes({"cut": content[:-200], "garbage": b"x" * 100, "empty": b"", "format": b"PK\3\4"}[damage])
    found = Refreshes(run).summaries()
    assert [entry["number"] for entry in found["snapshots"]] == [0]
    assert len(found["problems"]) == 1 and "refresh_00000016.npz" in found["problems"][0]


def test_a_snapshot_is_read_again_when_it_is_another(run: Path) -> None:
    refreshes = Refreshes(run)
    before = refreshes.summaries()["snapshots"][0]
    write_refresh(run, 0, np.random.default_rng(9))
    assert refreshes.summaries()["snapshots"][0]["candidates"] != before["candidates"]


def test_levels_are_sorted_filtered_and_paged(run: Path) -> None:
    refreshes = Refreshes(run)
    snapshot, plays = refreshes.snapshot(REFRESH, 0), refreshes.plays(0)

    def page(**fields: Any) -> dict[str, Any]:
        defaults: dict[str, Any] = {"sort": "slot", "descending": False, "filter_text": "", "offset": 0, "limit": 100}
        return level_page(snapshot, plays, **{**defaults, **fields})

    assert [level["index"] for level in page()["levels"]] == list(range(8))
    assert [level["index"] for level in page(offset=3, limit=2)["levels"]] == [3, 4]
    by_p = [level["training"]["rate"] for level in page(sort="p_training", descending=True)["levels"]]
    assert by_p == sorted(by_p, reverse=True)
    chosen = page(filter_text="joints>=1 shapes < 2")
    features = [level["features"] for level in chosen["levels"]]
    assert all(f["joints"] >= 1 and f["shapes"] < 2 for f in features) and chosen["matching"] == len(features)
    with pytest.raises(LevelQueryError, match="the filter names 'wheels'"):
        page(filter_text="wheels>1")
    with pytest.raises(LevelQueryError, match="write conditions such as"):
        page(filter_text="joints >= many")
    with pytest.raises(LevelQueryError, match="no 'weight'"):
        page(sort="weight")


@pytest.fixture
def run_of_a_level(tmp_path: Path) -> Path:
    """Two refreshes, the second with plays of the first's levels 0, 1 and 5; three windows of the first."""
    chance = np.random.default_rng(3)
    write_refresh(tmp_path, 0, chance)
    write_refresh(tmp_path, 16, chance, probe_of=0)
    for first, last, solved, finished in ((2, 6, 1, 4), (6, 10, 0, 0), (10, 14, 3, 3)):
        counts = [[0] * 8, [0] * 8]
        counts[0][5], counts[1][5] = solved, finished
        append_line(tmp_path / DIRECTORY / OUTCOMES, window(0, first, last, *counts))
    return tmp_path


def test_scored_trained_and_played_again(run_of_a_level: Path) -> None:
    snapshots, windows, problems = Refreshes(run_of_a_level).read()
    history = level_history(snapshots, windows, "refresh", 0, 5)
    first = snapshots[0].arrays
    assert not problems and history["id"] == f"{int(first['level_id'][5]):016x}"
    [scored] = history["snapshots"]
    assert (scored["number"], scored["update"], scored["index"]) == (0, 2, 5)
    assert (scored["scored"]["solved"], scored["scored"]["episodes"]) == (first["solved"][5], first["finished"][5])
    assert [(w["update"], w["solved"], w["episodes"]) for w in history["windows"]] == [(6, 1, 4), (14, 3, 3)]
    [again] = history["played_again"]
    assert (again["policy_version"], again["solved"], again["episodes"]) == (16, 2, 4)


def test_a_level_that_was_never_played_has_none(run_of_a_level: Path) -> None:
    snapshots, windows, _ = Refreshes(run_of_a_level).read()
    history = level_history(snapshots, windows, "refresh", 16, 2)
    assert len(history["snapshots"]) == 1 and not history["windows"] and not history["played_again"]


def test_the_same_level_in_several_snapshots_of_a_replay_buffer(tmp_path: Path) -> None:
    for number, ids, scores in ((10, [7, 8], [0.5, 0.25]), (20, [9, 7], [-np.inf, 0.125])):
        arrays = {
            "curriculum": np.str_("plr"), "size": np.str_("s"), "policy_version": np.int32(number),
            "written_after": np.int32(number), "level_id": np.array(ids, np.uint64),
            "score": np.array(scores, np.float32), "features": np.zeros((2, 1), np.uint8),
            "feature_names": np.array(["shapes"]), "slot": np.arange(2, dtype=np.int32),
        }  # fmt: skip
        (tmp_path / DIRECTORY).mkdir(exist_ok=True)
        write_snapshot(tmp_path / DIRECTORY, BUFFER, number, arrays)
    snapshots, windows, _ = Refreshes(tmp_path).read()
    history = level_history(snapshots, windows, "buffer", 20, 1)
    assert [(s["number"], s["index"], s["score"]) for s in history["snapshots"]] == [(10, 0, 0.5), (20, 1, 0.125)]
    assert level_history(snapshots, windows, "buffer", 20, 0)["snapshots"][0]["score"] is None


@pytest.mark.parametrize(("number", "index"), [(1, 0), (0, 8)])
def test_one_that_is_not_there(run_of_a_level: Path, number: int, index: int) -> None:
    snapshots, windows, _ = Refreshes(run_of_a_level).read()
    with pytest.raises(LookupError):
        level_history(snapshots, windows, "refresh", number, index)
