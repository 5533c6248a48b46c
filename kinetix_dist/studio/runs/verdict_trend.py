"""Trend of a verdict: solve rates of training over time, of levels that no curriculum chooses.

Solve rates in training are of the fresh levels, an unbiased sample of the generator: those of a buffer fall with every
refresh. Windows are joined into CHUNKS parts of equal count. The last part is compared with the first and with the
best, and a line through the last half of the parts says whether the rate still rises. Parts before the
current phase are left out, since another phase has other levels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.evaluation.intervals import Z_95, Estimate, difference_interval, wilson_interval, z_95
from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.studio.runs.statements import (
    BAD,
    GOOD,
    NEUTRAL,
    UNKNOWN,
    Statement,
    change,
    counted,
    is_above,
    is_below,
    percent,
    points,
    rate_with_count,
)

CHUNKS = 10
MIN_ATTEMPTS = 100  # of a part that is compared
MIN_ROWS = 20  # of metrics, where there are no windows
MIN_PARTS_OF_LINE = 3
LOST_SHARE = 0.5  # of its best: a solve rate that fell so far collapsed
ALL_LEVELS = "all levels"  # source of a run without counts: those of the buffer, too
FRESH_PANEL = "Solve rate in training"  # of page Curriculum


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """Solve rate over some updates. text: with its counts."""

    rate: float
    low: float
    high: float
    error: float  # standard error of the rate
    first_update: int
    last_update: int
    text: str

    @property
    def when(self) -> str:
        return f"updates {self.first_update:,} to {self.last_update:,}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trend:
    """Parts of a run, oldest first; at least two. source: of the levels."""

    source: str
    parts: tuple[Part, ...]
    link: tuple[str, str]  # page and panel

    @property
    def since_first(self) -> Estimate:
        return difference_interval(_estimate(self.parts[-1]), _estimate(self.parts[0]))

    @property
    def best(self) -> Part:
        return max(self.parts, key=lambda part: part.rate)

    @property
    def since_best(self) -> Estimate | None:
        """None where the last part is the best one. Intervals of parts are of all comparisons together."""
        best, last = self.best, self.parts[-1]
        return None if best is last else difference_interval(_estimate(last), _estimate(best))

    @property
    def late(self) -> Estimate | None:
        """Change over the last half of the parts, by a line through them; None where these are too few, or one of them
        has rows of one value, whose error is not known."""
        late = self.parts[len(self.parts) // 2 :]
        is_known = len(late) >= MIN_PARTS_OF_LINE and all(part.error > 0 for part in late)
        return _change_of_line(late) if is_known else None

    @property
    def has_fallen(self) -> bool:
        """Half of its best is gone, by more than chance."""
        return self.parts[-1].rate <= LOST_SHARE * self.best.rate and is_below(self.since_best)


def _estimate(part: Part) -> Estimate:
    return part.rate, part.low, part.high


def _change_of_line(parts: Sequence[Part]) -> Estimate:
    """Rise of a line from the middle of the first part to that of the last one: weighted least squares, by the errors
    of the parts, which are independent."""
    x = np.array([part.first_update + part.last_update for part in parts]) / 2
    rates, weights = np.array([part.rate for part in parts]), np.array([part.error for part in parts]) ** -2.0
    centred = x - np.average(x, weights=weights)
    slope = float((weights * centred * rates).sum() / (weights * centred**2).sum())
    span, margin = float(x[-1] - x[0]), Z_95 * float((weights * centred**2).sum() ** -0.5)
    return slope * span, (slope - margin) * span, (slope + margin) * span


def phase_start(table: SeriesTable) -> int:
    """Update after which the phase of the last row began; 0 for a run in its first."""
    phases, updates = table.column("progress/phase"), table.column("update")
    other = np.flatnonzero(phases != phases[-1]) if len(phases) and not np.isnan(phases[-1]) else np.zeros(0, int)
    return int(updates[other[-1]]) if len(other) else 0


def trend_of(table: SeriesTable, windows: Sequence[Mapping[str, Any]]) -> Trend | None:
    """Solve rates of fresh levels over the phase of now; None where there are too few.

    Of all levels where no window says where levels came from. A curriculum that chooses all levels has no trend: it may
    choose harder ones.
    """
    start = phase_start(table)
    if not windows:
        return _trend_of_rows(table, start)
    return _trend_of_windows([row for row in windows if row["from_update"] >= start])


def _trend_of_windows(windows: Sequence[Mapping[str, Any]]) -> Trend | None:
    counts = [(row["from_update"], row["update"], *counted) for row in windows if (counted := _fresh_counts(row))]
    total = sum(attempts for *_, attempts in counts)
    size = max(-(-total // CHUNKS), MIN_ATTEMPTS)
    parts: list[list[int]] = []
    for first, last, solved, attempts in counts:
        if not parts or parts[-1][3] >= size:
            parts.append([first, last, 0, 0])
        parts[-1][1], parts[-1][2], parts[-1][3] = last, parts[-1][2] + solved, parts[-1][3] + attempts
    if len(parts) > 1 and parts[-1][3] < MIN_ATTEMPTS:  # what is left joins the part before
        last = parts.pop()
        parts[-1] = [parts[-1][0], last[1], parts[-1][2] + last[2], parts[-1][3] + last[3]]
    if len(parts) < 2:
        return None
    z = z_95(len(parts) - 1)
    return Trend(
        source="fresh levels" if "fresh" in windows[-1]["sources"] else "its level set",
        parts=tuple(_part_of_counts(*part, z=z) for part in parts),
        link=("curriculum", FRESH_PANEL),
    )


def _fresh_counts(row: Mapping[str, Any]) -> tuple[int, int] | None:
    """(solved, attempts) of levels that no curriculum chooses: fresh ones, or those of a fixed set."""
    if "fresh" in row["sources"]:
        fresh = row["sources"]["fresh"]
        return (fresh["solved"], fresh["attempts"]) if fresh["attempts"] else None
    if "solved" in row and "buffer" not in row and sum(row["attempts"]):
        return sum(row["solved"]), sum(row["attempts"])
    return None


def _part_of_counts(first: int, last: int, solved: int, attempts: int, *, z: float) -> Part:
    low, high = wilson_interval(solved, attempts, z)
    plain = wilson_interval(solved, attempts)
    return Part(
        rate=solved / attempts,
        low=low,
        high=high,
        error=(plain[1] - plain[0]) / (2 * Z_95),  # above 0 where none or all were solved, too
        first_update=first,
        last_update=last,
        text=rate_with_count(solved, attempts, *plain),
    )


def _trend_of_rows(table: SeriesTable, start: int) -> Trend | None:
    """Trend of a run without counts: means of rows, with intervals over rows."""
    updates, rates = table.column("update"), table.column("train/solve_rate")
    is_known = ~np.isnan(rates) & (updates > start)
    updates, rates = updates[is_known], rates[is_known]
    if len(rates) < MIN_ROWS:
        return None
    parts = []
    chunks = min(CHUNKS, len(rates) // (MIN_ROWS // 2))
    for rows in np.array_split(np.arange(len(rates)), chunks):
        mean, error = float(rates[rows].mean()), float(rates[rows].std(ddof=1) / np.sqrt(len(rows)))
        margin = z_95(chunks - 1) * error
        parts.append(
            Part(
                rate=mean,
                low=mean - margin,
                high=mean + margin,
                error=error,
                first_update=int(updates[rows[0]]),
                last_update=int(updates[rows[-1]]),
                text=f"{percent(mean)} (mean of {counted(len(rows), 'row')})",
            )
        )
    return Trend(source=ALL_LEVELS, parts=tuple(parts), link=("overview", "Training episodes"))


def trend_statement(trend: Trend | None) -> Statement:
    title = "Solve rate in training"
    if trend is None:
        sentence = (
            f"Needs two parts of {MIN_ATTEMPTS} attempts at fresh levels (curriculum/outcomes.jsonl); they are not "
            "there (yet)."
        )
        return Statement(key="training", title=title, state=UNKNOWN, sentence=sentence, page="curriculum")
    first, best, last, difference = trend.parts[0], trend.best, trend.parts[-1], trend.since_first
    source = f"{trend.source[0].upper()}{trend.source[1:]}"
    sentence = f"{source}: {first.text} in {first.when} → {last.text} in {last.when}: {change(difference)}."
    if trend.since_best is None:
        sentence += " The last part is the best one."
    elif best is not first:
        sentence += f" The best part was {percent(best.rate)} in {best.when}; since then {change(trend.since_best)}."
    if trend.late is not None:
        sentence += f" A line through the last half {_direction(trend.late)} ({points(trend.late)})."
    if trend.source == ALL_LEVELS:
        sentence += " A buffer that changes moves this rate, too."
    page, panel = trend.link
    return Statement(
        key="training",
        title=title,
        state=NEUTRAL if trend.source == ALL_LEVELS else _state(trend),
        sentence=sentence,
        page=page,
        query={"panel": panel},
    )


def _state(trend: Trend) -> str:
    if is_below(trend.since_first):
        return BAD
    has_fallen = is_below(trend.since_best) or is_below(trend.late)
    return GOOD if is_above(trend.since_first) and not has_fallen else NEUTRAL


def _direction(change_of_line: Estimate) -> str:
    if is_above(change_of_line):
        return "still rises"
    return "falls" if is_below(change_of_line) else "neither rises nor falls by more than chance"
