"""Warnings about a run: a table of rules over its metrics.

A rule reads columns of metrics and returns one line where it holds, with its numbers. The remedy is that of
`telemetry.names.RED`, where there is one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.studio.runs.statements import BAD, GOOD, Statement
from kinetix_dist.telemetry.names import RED

RECENT_ROWS = 10  # over which levels are judged, so that one update alone does not warn

SPEED, STABILITY = "speed", "stability"  # parts of a verdict, by the keys of their statements
Check = Callable[[SeriesTable], str | None]


@dataclasses.dataclass(frozen=True)
class Rule:
    """Rule about a metric. condition: in words; check: the finding in one line, or None."""

    metric: str
    condition: str
    check: Check
    part: str = ""  # of a verdict that states it; "": it has a statement of its own


@dataclasses.dataclass(frozen=True, kw_only=True)
class Warned:
    """Rule that holds for a run, with its numbers in one line, and what may help."""

    rule: Rule
    finding: str
    remedy: str


def _recent(table: SeriesTable, name: str) -> np.ndarray:
    """Last known values of a metric; empty where there are none."""
    return table.known(name)[-RECENT_ROWS:]


def _mean_above(name: str, limit: float) -> Rule:
    def check(table: SeriesTable) -> str | None:
        values = _recent(table, name)
        return (
            f"{values.mean():.3g} in the last {_rows(len(values))}" if len(values) and values.mean() > limit else None
        )

    return Rule(name, f"mean of {RECENT_ROWS} rows above {limit:g}", check)


def _mean_below(name: str, limit: float) -> Rule:
    def check(table: SeriesTable) -> str | None:
        values = _recent(table, name)
        return (
            f"{values.mean():.3g} in the last {_rows(len(values))}" if len(values) and values.mean() < limit else None
        )

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
    dataclasses.replace(_ever_above("learner/skipped_steps", 0), part=STABILITY),
    _ever_above("runtime/dropped_steps", 0),
    _ever_above("runtime/restarts", 0),
    _mean_above("learner/approx_kl", 0.1),
    _mean_above("learner/clip_fraction", 0.4),
    dataclasses.replace(_share_of_first("learner/entropy", 0.05), part=STABILITY),
    _ever_above("physics/unstable", 0),
    dataclasses.replace(_mean_above("time/idle", 0.2), part=SPEED),
    dataclasses.replace(_mean_above("time/curate", 0.1), part=SPEED),
    dataclasses.replace(_mean_above("time/checkpoint", 0.05), part=SPEED),
    _last_above("memory/host_share", 0.9),
    _last_above("memory/gpu_share", 0.98),
    _last_above("telemetry/dropped_rows", 0),
)


def warnings_of(table: SeriesTable) -> list[Warned]:
    """Rules that hold."""
    found = [(rule, rule.check(table)) for rule in RULES]
    return [
        Warned(rule=rule, finding=finding, remedy=RED[rule.metric][1] if rule.metric in RED else "")
        for rule, finding in found
        if finding is not None
    ]


def warning_statements(warnings: Sequence[Warned]) -> list[Statement]:
    """A statement for each warning that no other part of a verdict states; one that says so where there is none."""
    found = [
        Statement(
            key=f"warning/{one.rule.metric}",
            title=one.rule.metric,
            state=BAD,
            sentence=f"{one.finding} (rule: {one.rule.condition}).",
            remedy=one.remedy,
            query={"panel": one.rule.metric},
        )
        for one in warnings
        if not one.rule.part
    ]
    if found:
        return found
    others = "None of other metrics: see the parts above" if warnings else "None"
    return [Statement(key="warnings", title="Warnings", state=GOOD, sentence=f"{others}.")]


def _rows(count: int) -> str:
    return f"{count} row" if count == 1 else f"{count} rows"
