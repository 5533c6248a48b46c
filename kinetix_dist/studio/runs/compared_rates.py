"""Held-out solve rates of several runs: curves over an axis, random actions, and a table of runs.

evaluations(run) --rate_curve--> metric "evaluation/<set>/solve_rate" over env steps, updates, seconds or the date
                 --run_rows----> random, before, now and best of each set; gains with intervals
                 --baselines---> random actions, over the runs that play the same levels in the same environment
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.evaluation.intervals import for_readers, wilson_interval
from kinetix_dist.evaluation.rate_difference import difference_for_readers, difference_of_rates
from kinetix_dist.json_text import json_text
from kinetix_dist.level.level_data import base_levels
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.compare import flat_config
from kinetix_dist.studio.runs.evaluations import PHASES
from kinetix_dist.studio.runs.series import SeriesTable, axis_values

RANDOM, BEFORE = PHASES[:2]
NO_EVALUATION = f"no evaluation so far ({run_files.EVALUATION_LINES})"
NO_SETS = "it evaluates on nothing: evaluation.sets is empty"
NOT_TRAINED = "no evaluation since training began"


def metric_of(set_name: str) -> str:
    """Name of the solve rate of an evaluation set among metrics."""
    return f"evaluation/{set_name}/solve_rate"


def set_of(metric: str) -> str | None:
    """The evaluation set whose solve rate a metric is; None for other metrics."""
    found = re.fullmatch(r"evaluation/(.+)/solve_rate", metric)
    return found[1] if found else None


@dataclasses.dataclass(frozen=True)
class RateCurve:
    """Solve rates of a policy, [evaluations] each: x rising, rate, 95 % interval, episodes."""

    x: np.ndarray
    rate: np.ndarray
    low: np.ndarray
    high: np.ndarray
    episodes: np.ndarray


def rate_curve(
    points: Sequence[Mapping[str, Any]], axis: str, table: SeriesTable, anchors: Sequence[tuple[int, float]]
) -> RateCurve:
    """Curve of the evaluations of one set, the one before training included, random actions left out.

    table, anchors: metrics and dated events of the run, which place an update on the axes `seconds` and `time`.
    An evaluation whose place is not known is left out. Raises AxisError.
    """
    points = policy_points(points)
    place = {"env_steps": "env_steps", "updates": "update"}.get(axis)
    if place is not None:
        x = np.array([np.nan if point[place] is None else point[place] for point in points], float)
    else:
        x = _at_updates(table, axis, anchors, [point["update"] for point in points])
    known = np.isfinite(x)
    intervals = np.array([for_readers(point) for point in points], float).reshape(-1, 2)
    return RateCurve(
        x=x[known],
        rate=np.array([point["rate"] for point in points], float)[known],
        low=intervals[known, 0],
        high=intervals[known, 1],
        episodes=np.array([point["episodes"] for point in points], int)[known],
    )


def policy_points(points: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Evaluations of the policy, one per update, the newest last."""
    of_policy = [point for point in points if point["phase"] != RANDOM and point["rate"] is not None]
    ordered = sorted(of_policy, key=lambda point: (point["update"] or 0, PHASES.index(point["phase"])))
    # The last update may be evaluated as one of training and after it: the later counts.
    return list({(point["update"], point["phase"] == BEFORE): point for point in ordered}.values())


def _at_updates(
    table: SeriesTable, axis: str, anchors: Sequence[tuple[int, float]], updates: Sequence[int | None]
) -> np.ndarray:
    """Places of updates on an axis, by the rows of metrics; nan where these do not say. Raises AxisError."""
    wanted = np.array([np.nan if update is None else update for update in updates], float)
    if not table.num_rows:
        return np.full(len(wanted), np.nan)
    x, seconds = axis_values(table, axis, anchors), table.column("progress/seconds")
    known = np.isfinite(x) & np.isfinite(seconds)
    if not known.any():
        return np.full(len(wanted), np.nan)
    start = x[known][0] - seconds[known][0]  # of update 0, which has no row
    return np.interp(wanted, np.r_[0.0, table.column("update")[known]], np.r_[start, x[known]])


def run_rows(
    run: str,
    config: Mapping[str, Any],
    sets: Mapping[str, Mapping[str, Any]],
    table: SeriesTable,
    problem: str | None = None,
) -> list[dict[str, Any]]:
    """Rows of the table of a run, one per evaluation set; one with a `reason` where there is no rate.

    sets: those of `evaluations.evaluations`. problem: why they cannot be read.
    """
    fields = flat_config(config)
    about = {"run": run, "curriculum": fields.get("curriculum.name"), "seed": fields.get("run.seed")}
    rows = [about | {"set": name} | _rates_of_set(name, entry, table) for name, entry in sets.items()]
    if rows:
        return rows
    is_off = fields.get("evaluation.sets") == []
    empty = dict.fromkeys(("random", "before", "now", "best", "gain_before", "gain_random"))
    reason = problem or (NO_SETS if is_off else NO_EVALUATION)
    return [about | {"set": None, "evaluations": 0, "reason": reason} | empty | _progress(table, None)]


def _rates_of_set(name: str, entry: Mapping[str, Any], table: SeriesTable) -> dict[str, Any]:
    points = policy_points(entry["points"])
    trained = [point for point in points if point["phase"] != BEFORE]
    before = next((point for point in points if point["phase"] == BEFORE), None)
    random = next((p for p in entry["points"] if p["phase"] == RANDOM and p["rate"] is not None), None)
    now = trained[-1] if trained else None
    best = max(trained, key=lambda point: point["rate"], default=None)
    bases = None if entry["names"] is None else base_levels(name, entry["names"])
    return {
        "random": _rate(random),
        "before": _rate(before),
        "now": _rate(now),
        "best": _rate(best),
        "gain_before": _gain(now, before, bases),
        "gain_random": _gain(now, random, bases),
        "evaluations": len(trained),
        "reason": None if now else NOT_TRAINED,
        **_progress(table, now),
    }


def _progress(table: SeriesTable, now: Mapping[str, Any] | None) -> dict[str, Any]:
    """Env steps and training seconds at an evaluation; those of the last row without one. None where not known."""
    if now is not None:
        has_seconds = not np.isnan(table.column("progress/seconds")).all()
        (seconds,) = _at_updates(table, "seconds", (), [now["update"]]) if has_seconds else (np.nan,)
        return {"env_steps": now["env_steps"], "seconds": float(seconds) if np.isfinite(seconds) else None}
    last = {name: table.column(name)[-1:] for name in ("progress/env_steps", "progress/seconds")}
    steps, seconds = (float(v[0]) if len(v) and np.isfinite(v[0]) else None for v in last.values())
    return {"env_steps": steps, "seconds": seconds}


def _num_solved(point: Mapping[str, Any]) -> int:
    """Solved attempts of a set; by its rate where an older run has no counts of levels."""
    return sum(point["solved"]) if point["solved"] is not None else round(point["rate"] * point["episodes"])


def _rate(point: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if point is None:
        return None
    low, high = for_readers(point)
    return {
        "rate": point["rate"],
        "low": low,
        "high": high,
        "solved": _num_solved(point),
        "episodes": point["episodes"],
        "update": point["update"],
    }


def _gain(
    point: Mapping[str, Any] | None, other: Mapping[str, Any] | None, bases: Sequence[str] | None
) -> dict[str, Any] | None:
    """Rate less another with its 95 % interval; None where one of them is missing, or has no episodes."""
    if point is None or other is None or not point["episodes"] or not other["episodes"]:
        return None
    if bases is not None and point["solved"] is not None and other["solved"] is not None:
        found = difference_for_readers(point["solved"], point["attempts"], other["solved"], other["attempts"], bases)
    else:
        found = difference_of_rates(_num_solved(point), point["episodes"], _num_solved(other), other["episodes"])
    return found._asdict()


def baselines(sets: Mapping[str, Mapping[str, Any]], configs: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Random actions {runs, rate, low, high, solved, episodes} on one evaluation set of several runs.

    sets: {run: entry of `evaluations.evaluations`}. Runs with the same levels and the same `env` of their configs are
    put together: random actions have one rate there, and the attempts of all of these runs are of it.
    """
    found: dict[str, dict[str, Any]] = {}
    for run, entry in sets.items():
        point = next((p for p in entry["points"] if p["phase"] == RANDOM and p["rate"] is not None), None)
        if point is None:
            continue
        key = json_text([entry["names"], configs.get(run, {}).get("env")], sort_keys=True)
        shared = found.setdefault(key, {"runs": [], "solved": 0, "episodes": 0})
        shared["runs"].append(run)
        shared["solved"] += _num_solved(point)
        shared["episodes"] += point["episodes"]
    for shared in found.values():
        shared["rate"] = shared["solved"] / shared["episodes"] if shared["episodes"] else None
        shared["low"], shared["high"] = wilson_interval(shared["solved"], shared["episodes"])
    return list(found.values())


def other_levels(sets: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> list[str]:
    """Lines about evaluation sets of one name that have other levels in some runs. sets: {run: {set: entry}}."""
    problems = []
    for name in dict.fromkeys(name for entries in sets.values() for name in entries):
        levels: dict[tuple[str, ...], list[str]] = {}
        for run, entries in sets.items():
            if name in entries and entries[name]["names"] is not None:
                levels.setdefault(tuple(entries[name]["names"]), []).append(run)
        if len(levels) > 1:
            groups = " and ".join(f"{len(names)} in {', '.join(runs)}" for names, runs in levels.items())
            problems.append(f"set {name} has other levels ({groups}): these rates are not of the same levels")
    return problems
