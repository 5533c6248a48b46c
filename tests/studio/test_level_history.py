"""A level over a run, found by its id, against counts by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.studio.runs.snapshot_levels import level_history
from kinetix_dist.telemetry.curriculum_log import BUFFER, DIRECTORY, OUTCOMES, write_snapshot
from kinetix_dist.telemetry.json_lines import append_line
from tests.studio.test_refreshes import window, write_refresh


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two refreshes, the second with plays of the first's levels 0, 1 and 5; three windows of the first."""
    chance = np.random.default_rng(3)
    write_refresh(tmp_path, 0, chance)
    write_refresh(tmp_path, 16, chance, probe_of=0)
    for first, last, solved, finished in ((2, 6, 1, 4), (6, 10, 0, 0), (10, 14, 3, 3)):
        counts = [[0] * 8, [0] * 8]
        counts[0][5], counts[1][5] = solved, finished
        append_line(tmp_path / DIRECTORY / OUTCOMES, window(0, first, last, *counts))
    return tmp_path


def test_scored_trained_and_played_again(run: Path) -> None:
    snapshots, windows, problems = Refreshes(run).read()
    history = level_history(snapshots, windows, "refresh", 0, 5)
    first = snapshots[0].arrays
    assert not problems and history["id"] == f"{int(first['level_id'][5]):016x}"
    [scored] = history["snapshots"]
    assert (scored["number"], scored["update"], scored["index"]) == (0, 2, 5)
    assert (scored["scored"]["solved"], scored["scored"]["episodes"]) == (first["solved"][5], first["finished"][5])
    assert [(w["update"], w["solved"], w["episodes"]) for w in history["windows"]] == [(6, 1, 4), (14, 3, 3)]
    [again] = history["played_again"]
    assert (again["policy_version"], again["solved"], again["episodes"]) == (16, 2, 4)


def test_a_level_that_was_played_by_nobody_has_none(run: Path) -> None:
    snapshots, windows, _ = Refreshes(run).read()
    history = level_history(snapshots, windows, "refresh", 16, 2)
    assert len(history["snapshots"]) == 1 and not history["windows"] and not history["played_again"]


def test_the_same_level_in_several_snapshots_of_a_replay_buffer(tmp_path: Path) -> None:
    for number, ids, scores in ((10, [7, 8], [0.5, 0.25]), (20, [9, 7], [-np.inf, 0.125])):
        arrays = {
            "curriculum": np.str_("plr"), "size": np.str_("s"), "policy_version": np.int32(number),
            "written_after": np.int32(number), "level_id": np.array(ids, np.uint64),
            "score": np.array(scores, np.float32), "features": np.zeros((2, 1), np.uint8),
            "feature_names": np.array(["shapes"]), "place": np.arange(2, dtype=np.int32),
        }  # fmt: skip
        (tmp_path / DIRECTORY).mkdir(exist_ok=True)
        write_snapshot(tmp_path / DIRECTORY, BUFFER, number, arrays)
    snapshots, windows, _ = Refreshes(tmp_path).read()
    history = level_history(snapshots, windows, "buffer", 20, 1)
    assert [(s["number"], s["index"], s["score"]) for s in history["snapshots"]] == [(10, 0, 0.5), (20, 1, 0.125)]
    assert level_history(snapshots, windows, "buffer", 20, 0)["snapshots"][0]["score"] is None


@pytest.mark.parametrize(("number", "index"), [(1, 0), (0, 8)])
def test_one_that_is_not_there(run: Path, number: int, index: int) -> None:
    snapshots, windows, _ = Refreshes(run).read()
    with pytest.raises(LookupError):
        level_history(snapshots, windows, "refresh", number, index)
