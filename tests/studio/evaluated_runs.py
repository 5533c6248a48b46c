"""Runs with evaluations as training writes them, of solved attempts that a test chooses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from kinetix_dist.telemetry.json_lines import append_line
from tests.studio.runs_for_tests import STEPS, write_run


def write_evaluation(
    run: Path, phase: str, update: int, sets: Mapping[str, Sequence[int]], *, attempts: int = 4, prefix: str = ""
) -> None:
    """A line of evaluations.jsonl. sets: solved attempts of each level, which are named by the set (and `prefix`)."""
    results = {
        name: {"names": [f"{prefix}{name}_{k}" for k in range(len(solved))], "solved": solved, "attempts": attempts}
        for name, solved in sets.items()
    }
    line = {"format": 1, "phase": phase, "update": update, "env_steps": STEPS * update, "reported_at": update}
    append_line(run / "evaluations.jsonl", {**line, "sets": results})


def write_evaluated_run(run: Path, *, before: int, after: int, seed: int = 0, levels: int = 8) -> Path:
    """A run of 20 updates on set `random_s`: 4 attempts of each level, of which random actions solve one.

    before, after: solved attempts of every level at update 0 and 20; halfway there the mean, rounded down.
    """
    write_run(run, 20, run={"seed": seed})
    write_evaluation(run, "random_policy", 0, {"random_s": [1] * levels})
    write_evaluation(run, "before", 0, {"random_s": [before] * levels})
    write_evaluation(run, "training", 10, {"random_s": [(before + after) // 2] * levels})
    write_evaluation(run, "after", 20, {"random_s": [after] * levels})
    return run
