"""Warnings about a run: a table of rules over its metrics.

A rule reads columns of metrics and returns one line where it holds, with its numbers. The remedy is that of
`telemetry.names.RED`, where there is one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.telemetry.names import RED

RECENT_ROWS = 10  # over which levels are judged, so that one update alone does not warn

Check = Callable[[SeriesTable], str | None]


@dataclasses.dataclass(frozen=True)
class Rule:
    """Rule about a metric. condition: in words; check: the finding in one line, or None."""

    metric: str
    condition: str
    check: Check


def _recent(table: SeriesTable, name: str) -> np.ndarray:
    """Last known values of a metric; empty where there are none."""
    column = table.column(name)
    return column[~np.isnan(column)][-RECENT_ROWS:]


def _mean_above(name: str, limit: float) -> Rule:
    def check(table: SeriesTable) -> str | None:
        values = _recent(table, name)
        return f"{values.mean():.3g} in the last {_rows(len(values))}" if len(values) and values.mean() > limit else None

    return Rule(name, f"mean of {RECENT_ROWS} rows above {limit:g}", check)


def _mean_below(name: str, limit: float) -> Rule:
    def check(table: SeriesTable) -> str | None:
        values = _recent(table, name)
        return f"{values.mean():.3g} in the last {_rows(len(values))}" if len(values) and values.mean() < limit else None

    return Rule(name, f"mean of {RECENT_ROWS} rows below {limit:g}", check)


def _last_above(name: str, limit: float) -> Rule:
    def check(table: SeriesTable) -> str | None:
        values = _recent(table, name)
        return f"{values[-1]:.3g} in the last row" if len(values) and values[-1] > limit else None

    return Rule(name, f"last row above {limit:g}", check)


def _ever_above(name: str, limit: float) -> Rule:
    def check(table: SeriesTable) -> str | None:
        column = table.column(name)
        rows = np.flatnonzero(column > limit)
        if not len(rows):
            return None
        updates = table.column("update")[rows]
        return f"in {_rows(len(rows))}, last at update {updates[-1]:.0f}, highest {np.nanmax(column):.3g}"

    return Rule(name, f"any row above {limit:g}", check)


def _share_of_first(name: str, share: float) -> Rule:
    def check(table: SeriesTable) -> str | None:
        column = table.column(name)
        first, values = column[~np.isnan(column)][:1], _recent(table, name)
        if not len(first) or first[0] <= 0 or values.mean() >= share * first[0]:
            return None
        return f"{values.mean():.3g} in the last {_rows(len(values))}, {first[0]:.3g} in the first"

    return Rule(name, f"mean of {RECENT_ROWS} rows below {share:.0%} of the first row", check)


RULES: tuple[Rule, ...] = (
    _last_above("curriculum/buffer_is_stale", 0),
    _mean_below("curriculum/learnable_share", 0.01),
    _ever_above("learner/skipped_steps", 0),
    _ever_above("runtime/dropped_steps", 0),
    _ever_above("runtime/restarts", 0),
    _mean_above("learner/approx_kl", 0.1),
    _mean_above("learner/clip_fraction", 0.4),
    _share_of_first("learner/entropy", 0.05),
    _ever_above("physics/unstable", 0),
    _mean_above("time/idle", 0.2),
    _mean_above("time/curate", 0.1),
    _mean_above("time/checkpoint", 0.05),
    _last_above("memory/host_share", 0.9),
    _last_above("memory/gpu_share", 0.98),
    _last_above("telemetry/dropped_rows", 0),
)


def warnings_of(table: SeriesTable, evaluated: dict[str, Any] | None = None) -> list[dict[str, str]]:
    """Rules that hold, [{metric, rule, finding, remedy}]. evaluated: `evaluations.evaluations` of the run."""
    found = []
    for rule in RULES:
        finding = rule.check(table)
        if finding is not None:
            remedy = RED[rule.metric][1] if rule.metric in RED else ""
            found.append({"metric": rule.metric, "rule": rule.condition, "finding": finding, "remedy": remedy})
    return found + _falling_sets(evaluated or {"sets": {}})


def _falling_sets(evaluated: dict[str, Any]) -> list[dict[str, str]]:
    """Sets whose interval now lies below that of an earlier evaluation of the same run."""
    found = []
    for name, entry in evaluated["sets"].items():
        points = [point for point in entry["points"] if point["phase"] != "random_policy"]
        if len(points) < 2:
            continue
        best, last = max(points[:-1], key=lambda point: point["low"]), points[-1]
        if last["high"] < best["low"]:
            found.append(
                {
                    "metric": f"evaluation/{name}/solve_rate",
                    "rule": "95 % interval below that of an earlier evaluation",
                    "finding": f"{last['rate']:.1%} ({last['low']:.1%} to {last['high']:.1%}, {last['episodes']} "
                    f"attempts), at update {best['update']} {best['rate']:.1%} ({best['low']:.1%} to "
                    f"{best['high']:.1%}, {best['episodes']})",
                    "remedy": "lower ppo.learning_rate, or train on levels nearer to this set",
                }
            )
    return found


def _rows(count: int) -> str:
    return f"{count} row" if count == 1 else f"{count} rows"
