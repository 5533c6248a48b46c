"""Solve rates of a run: of each level at each evaluation, and of sets with intervals.

evaluations.jsonl has every level's solved attempts. A run without that file has rates of sets before and after training
in evaluations.json, without levels: `without_levels` is then true.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.evaluation.intervals import interval_over_levels, wilson_interval
from kinetix_dist.level.level_data import base_levels
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.run_files import damaged_lines, last_row, member, read_object
from kinetix_dist.telemetry.json_lines import read_lines

LAST_BYTES = 1 << 20  # in which the last line is looked for; a set of 2,048 levels has 50 kB
PHASES = ("random_policy", "before", "training", "after")  # of evaluations, in the order in which they happen


def evaluations(path: Path) -> dict[str, Any]:
    """Evaluations {sets: {name: {names, points}}, without_levels, problems} of a run directory.

    A point is {phase, update, env_steps, solved (of each level, or null), attempts (of each level, or null), rate,
    low, high, interval_over_levels, episodes}. Both intervals are of the rate of the set at 95 %: low and high are
    Wilson's over attempts, the other is over base levels (evaluation/intervals.py).
    Raises RunFileError where a file cannot be read at all.
    """
    problems: list[str] = []
    file = path / run_files.EVALUATION_LINES
    try:
        lines = read_lines(file, _is_evaluation)
    except OSError as error:
        raise run_files.RunFileError(f"{file.name} cannot be read ({error.strerror})") from error
    if lines.damaged:
        problems.append(damaged_lines(len(lines.damaged), file.name))
    if not lines.rows:
        return {"sets": _sets_without_levels(path), "without_levels": True, "problems": problems}
    newest = {
        (row["phase"], row["update"]): row for row in lines.rows
    }  # an evaluation that was repeated after a kill counts once
    rows = sorted(newest.values(), key=lambda row: (PHASES.index(row["phase"]), row["update"]))
    sets: dict[str, dict[str, Any]] = {}
    for row in rows:
        for name, result in row["sets"].items():
            entry = sets.setdefault(name, {"names": result["names"], "points": []})
            if entry["names"] != result["names"]:
                problems.append(f"set {name} had other levels at update {row['update']}; that evaluation is left out")
                continue
            entry["points"].append(_point(row, name, result))
    return {"sets": sets, "without_levels": False, "problems": problems}


def _point(row: dict[str, Any], name: str, result: dict[str, Any]) -> dict[str, Any]:
    solved, episodes = sum(result["solved"]), result["attempts"] * len(result["names"])
    low, high = wilson_interval(solved, episodes)
    return {
        "phase": row["phase"],
        "update": row["update"],
        "env_steps": row["env_steps"],
        "solved": result["solved"],
        "attempts": result["attempts"],
        "rate": solved / episodes if episodes else None,
        "low": low,
        "high": high,
        "interval_over_levels": interval_over_levels(
            result["solved"], result["attempts"], base_levels(name, result["names"])
        )
        if episodes
        else None,
        "episodes": episodes,
    }


def newest_rates(path: Path) -> dict[str, dict[str, Any]]:
    """Rates {set: {rate, low, high, interval_over_levels, attempts}} of the policy's last evaluation.

    Reads the ends of files only. Empty where there is none. Raises RunFileError.
    """
    last = last_row(path / run_files.EVALUATION_LINES, is_row=_is_evaluation, max_bytes=LAST_BYTES)
    if last.problem is not None:
        raise run_files.RunFileError(last.problem)
    if last.row is None:
        stored = member(read_object(path / run_files.REPORT) or {}, "solve_rate", dict, file=run_files.REPORT) or {}
        return _rates(stored, "after", file=run_files.REPORT)
    row = last.row
    if row["phase"] == PHASES[0]:
        return {}
    points = {name: _point(row, name, result) for name, result in row["sets"].items()}
    fields = ("rate", "low", "high", "interval_over_levels")
    return {
        name: {field: point[field] for field in fields} | {"attempts": point["episodes"]}
        for name, point in points.items()
    }


def _sets_without_levels(path: Path) -> dict[str, dict[str, Any]]:
    stored = read_object(path / run_files.EVALUATIONS) or {}
    report = read_object(path / run_files.REPORT) or {}
    sets: dict[str, dict[str, Any]] = {}
    for phase in PHASES:
        for name, rate in _rates(stored, phase, file=run_files.EVALUATIONS).items():
            is_last = phase == "after"
            point = {
                "phase": phase,
                "update": member(report, "policy_updates", int, file=run_files.REPORT) if is_last else 0,
                "env_steps": member(report, "env_steps", int, file=run_files.REPORT) if is_last else 0,
                "solved": None,
                "attempts": None,
                "rate": rate["rate"],
                "low": rate["low"],
                "high": rate["high"],
                "interval_over_levels": rate["interval_over_levels"],
                "episodes": rate["attempts"],
            }
            sets.setdefault(name, {"names": None, "points": []})["points"].append(point)
    return sets


def _rates(stored: Mapping[str, Any], phase: str, *, file: str) -> dict[str, dict[str, Any]]:
    """Rates {set: {rate, low, high, attempts, interval_over_levels}} of a phase, None where missing.

    Raises RunFileError.
    """
    found = {}
    sets = member(stored, phase, dict, file=file) or {}
    for name in sets:
        entry = member(sets, name, dict, file=file) or {}
        numbers = {key: member(entry, key, (int, float), file=file) for key in ("rate", "low", "high", "attempts")}
        found[name] = {**numbers, "interval_over_levels": member(entry, "interval_over_levels", dict, file=file)}
    return found


def _is_evaluation(row: dict[str, Any]) -> bool:
    if (
        row.get("phase") not in PHASES
        or not isinstance(row.get("update"), int)
        or not isinstance(row.get("sets"), dict)
    ):
        return False
    return isinstance(row.get("env_steps"), int) and all(
        isinstance(entry, dict)
        and isinstance(entry.get("names"), list)
        and all(isinstance(name, str) for name in entry["names"])
        and isinstance(entry.get("solved"), list)
        and len(entry["names"]) == len(entry["solved"])
        and isinstance(entry.get("attempts"), int)
        and all(isinstance(count, int) and 0 <= count <= entry["attempts"] for count in entry["solved"])
        for entry in row["sets"].values()
    )
