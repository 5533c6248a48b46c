"""The table of what a buffer claims and what training finds, of a made-up run whose levels have known p."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from bench import learnability
from kinetix_dist.evaluation.learnability import plug_in_learnability
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, OUTCOMES, REFRESH, write_snapshot
from kinetix_dist.telemetry.json_lines import append_line

NUM_CANDIDATES, NUM_KEPT, PLAYS = 2000, 500, 32


def scored(chance: np.random.Generator, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(solved, finished) of one world a level in 8 steps: a solved episode lasts 1 of them, another one 4."""
    solved, finished = np.zeros(len(p), np.int32), np.zeros(len(p), np.int32)
    for level in range(len(p)):
        steps_left = 8
        while (length := 1 if (is_solved := chance.random() < p[level]) else 4) <= steps_left:
            steps_left, finished[level], solved[level] = (
                steps_left - length,
                finished[level] + 1,
                solved[level] + is_solved,
            )
    return solved, finished


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, np.ndarray]:
    """(run, p of all candidates, p of those that were kept). The policy does not learn: p stays what it is."""
    path, chance = tmp_path_factory.mktemp("known") / "run", np.random.default_rng(4)
    (path / DIRECTORY).mkdir(parents=True)
    p = chance.choice([0.0, 0.2, 0.5, 0.9, 1.0], NUM_CANDIDATES)
    solved, finished = scored(chance, p)
    claimed = plug_in_learnability(solved, finished)
    kept = np.argsort(-claimed, kind="stable")[:NUM_KEPT]
    again = dict(zip(("solved", "finished"), scored(chance, p[kept]), strict=True))
    for version in (0, 16):
        probe = {"policy_version": np.int32(0), "index": np.arange(NUM_KEPT, dtype=np.int32), **again}
        arrays = {
            "curriculum": np.str_("sfl"), "size": np.str_("s"), "policy_version": np.int32(version),
            "written_after": np.int32(version), "first_batch": np.int32(version), "scoring_seconds": np.float64(1),
            "level_id": kept.astype(np.uint64), "score": claimed[kept].astype(np.float32),
            "features": np.zeros((NUM_KEPT, 1), np.uint8), "feature_names": np.array(["shapes"]),
            "candidate": kept.astype(np.int32), "solved": solved[kept], "finished": finished[kept],
            "candidates/solved": solved, "candidates/finished": finished,
            "candidates/features": np.zeros((NUM_CANDIDATES, 1), np.uint8),
            **({f"probe/{name}": values for name, values in probe.items()} if version else {}),
        }  # fmt: skip
        write_snapshot(path / DIRECTORY, REFRESH, version, arrays)
    attempts = np.bincount(chance.integers(0, NUM_KEPT, PLAYS * NUM_KEPT), minlength=NUM_KEPT)
    line = {
        "format": 2, "update": 16, "from_update": 0, "buffer": 0, "attempts": attempts.tolist(),
        "solved": chance.binomial(attempts, p[kept]).tolist(), "sources": {"fresh": {"attempts": 0, "solved": 0}},
    }  # fmt: skip
    append_line(path / DIRECTORY / OUTCOMES, line)
    return path, p, p[kept]


def test_what_training_finds_is_the_truth_and_what_was_claimed_is_not(run, tmp_path: Path, capsys) -> None:
    path, p, kept = run
    file = tmp_path / "found.json"
    assert learnability.run(argparse.Namespace(run=path, attempts=0, json=file)) == 0
    first, _ = json.loads(file.read_text())
    truth = (kept * (1 - kept)).mean()
    training = first["training"]
    assert abs(training["learnability"] - truth) < 3 * training["learnability_error"] < 0.01
    assert first["buffer"]["claimed"] > truth + 0.02, "levels are chosen for it by the same episodes"
    assert training["low"] <= kept.mean() <= training["high"] and training["high"] - training["low"] < 0.02
    after = first["probe"]["after"]
    assert after["low"] <= kept.mean() <= after["high"]
    assert after["solved"] / after["episodes"] > after["high"], "the same episodes, summed over levels"
    fresh = first["candidates"]
    assert abs(fresh["learnability"] - (p * (1 - p)).mean()) < 3 * fresh["learnability_error"]
    header, row, _ = capsys.readouterr().out.splitlines()
    assert header.split() == ["refresh", "levels", "claimed", "training", "fresh", "played", "chosen", "again"]
    assert f"{training['rate']:.1%}" in row
