"""Metrics of a run as columns, and curves of them with few points.

    rows of metrics.jsonl --SeriesTable.append--> columns (float64, nan where a row lacks a metric) --decimate--> curve

Updates of a table rise: a row of an earlier update (a run that went back to a checkpoint) removes what is later.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

FIRST_ROWS = 256  # capacity of a new table; doubled whenever it is full

# The horizontal axis of a curve: (name, metric that has it, unit). `time` follows from events, see `times_of_rows`.
AXES = {
    "env_steps": ("progress/env_steps", "env steps"),
    "updates": ("update", "updates"),
    "seconds": ("progress/seconds", "s"),
    "time": (None, "date"),
}


class AxisError(ValueError):
    """An unknown axis, or one that a run has no data for."""


class SeriesTable:
    """Rows of metrics as columns. `num_rows` rows are valid."""

    def __init__(self) -> None:
        self.num_rows = 0
        self._capacity = FIRST_ROWS
        self._columns: dict[str, np.ndarray] = {}

    @property
    def names(self) -> list[str]:
        """Metrics that any row had, in the order of their first appearance; without `update`."""
        return [name for name in self._columns if name != "update"]

    def column(self, name: str) -> np.ndarray:
        """[num_rows] float64; all nan where no row has it."""
        if name not in self._columns:
            return np.full(self.num_rows, np.nan)
        return self._columns[name][: self.num_rows]

    def known(self, name: str) -> np.ndarray:
        """Values [n] of the rows that have it."""
        column = self.column(name)
        return column[~np.isnan(column)]

    def append(self, rows: Iterable[Mapping[str, Any]]) -> int:
        """Adds rows, each with an int `update`; returns from which row on the table is new.

        A value that is no number (null stands for nan in JSON) is nan.
        """
        first_new = self.num_rows
        for row in rows:
            update = row["update"]
            if self.num_rows and update <= self._columns["update"][self.num_rows - 1]:
                self.num_rows = int(np.searchsorted(self.column("update"), update))
                first_new = min(first_new, self.num_rows)
                for column in self._columns.values():
                    column[self.num_rows :] = np.nan
            self._add(row)
        return first_new

    def can_extend(self, columns: Mapping[str, np.ndarray]) -> bool:
        """True where updates of the columns rise, from the last one of the table on."""
        updates = columns["update"]
        last = self._columns["update"][self.num_rows - 1] if self.num_rows else -np.inf
        return bool((np.diff(updates, prepend=last) > 0).all())

    def extend(self, columns: Mapping[str, np.ndarray]) -> None:
        """Adds rows as columns, [n] float64 each, nan where a row lacks a metric.

        Raises ValueError for updates that do not rise: `append` takes those.
        """
        if not self.can_extend(columns):
            raise ValueError("updates of these columns do not rise")
        end = self.num_rows + len(columns["update"])
        self._grow(end)
        for name, values in columns.items():
            if name not in self._columns:
                self._columns[name] = np.full(self._capacity, np.nan)
            self._columns[name][self.num_rows : end] = values
        self.num_rows = end

    def _grow(self, num_rows: int) -> None:
        while self._capacity < num_rows:
            self._capacity *= 2
        for name, column in self._columns.items():
            if len(column) < self._capacity:
                self._columns[name] = np.concatenate([column, np.full(self._capacity - len(column), np.nan)])

    def _add(self, row: Mapping[str, Any]) -> None:
        if self.num_rows == self._capacity:
            self._grow(self.num_rows + 1)
        for name, value in row.items():
            if isinstance(value, int | float):
                if name not in self._columns:
                    self._columns[name] = np.full(self._capacity, np.nan)
                self._columns[name][self.num_rows] = value
        self.num_rows += 1

    def rows(self, first: int) -> dict[str, list[float | None]]:
        """Columns of the rows from `first` on, with None for nan; metrics that none of these has are left out."""
        columns = {name: column[first : self.num_rows] for name, column in self._columns.items()}
        return {name: to_json(column) for name, column in columns.items() if not np.isnan(column).all()}


@dataclasses.dataclass(frozen=True)
class Curve:
    """Curve of few points, [points] each: x, and the smallest, largest and mean value of the rows behind a point."""

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mean: np.ndarray


def decimate(x: np.ndarray, y: np.ndarray, *, points: int) -> Curve:
    """Merges neighbouring rows, as many for each point. x, y: [n], x rising; nan does not count.

    x of a point is that of its last row, so that a curve ends where the data ends. Nothing is merged if n is at
    most `points`. Raises ValueError for points below 1.
    """
    if points < 1:
        raise ValueError(f"points is {points}; it must be 1 or more")
    size = -(-len(x) // points) if len(x) else 1
    starts = np.arange(0, len(x), size)
    if size == 1:
        return Curve(x=x, low=y, high=y, mean=y)
    ends = np.minimum(starts + size, len(x)) - 1
    counts = np.add.reduceat((~np.isnan(y)).astype(np.int64), starts)
    sums = np.add.reduceat(np.nan_to_num(y, nan=0.0, posinf=np.inf, neginf=-np.inf), starts)
    mean = np.divide(sums, counts, out=np.full(len(starts), np.nan), where=counts > 0)
    return Curve(x=x[ends], low=np.fmin.reduceat(y, starts), high=np.fmax.reduceat(y, starts), mean=mean)


def axis_values(table: SeriesTable, axis: str, anchors: Sequence[tuple[int, float]] = ()) -> np.ndarray:
    """Values [num_rows] of one of `AXES`. anchors: (update, unix time) of events, for axis `time`. Raises AxisError."""
    if axis not in AXES:
        raise AxisError(f"axis {axis!r} is none of {', '.join(AXES)}")
    metric, _ = AXES[axis]
    if metric is None:
        return times_of_rows(table, anchors)
    values = table.column(metric)
    if table.num_rows and np.isnan(values).all():
        raise AxisError(f"metrics of this run have no {metric}; choose another axis")
    return values


def times_of_rows(table: SeriesTable, anchors: Sequence[tuple[int, float]]) -> np.ndarray:
    """Unix times [num_rows], s: rows have seconds of the run, events have the date and often the update.

    A row has the date of the last event at or before its update, and the seconds since then. Sessions of a run that
    was resumed each have events of their own, so that the time in between is not counted as training.
    """
    if not anchors:
        raise AxisError("no event of this run names its update; choose another axis than time")
    updates = table.column("update")
    seconds = table.column("progress/seconds")
    anchor_update = np.array([update for update, _ in anchors], float)
    anchor_time = np.array([time for _, time in anchors])
    order = np.argsort(anchor_update, kind="stable")
    anchor_update, anchor_time = anchor_update[order], anchor_time[order]
    # Seconds of the run when the event happened: those of the row of its update; update 0 has no row: 0 s.
    known = ~np.isnan(seconds)
    at = np.interp(anchor_update, np.r_[0.0, updates[known]], np.r_[0.0, seconds[known]])
    index = np.clip(np.searchsorted(anchor_update, updates, side="right") - 1, 0, None)
    return anchor_time[index] + seconds - at[index]


def select(x: np.ndarray, start: float | None, end: float | None) -> slice:
    """Rows whose x is from `start` to `end`, and one more on each side, so that curves reach the edges."""
    first = 0 if start is None else max(int(np.searchsorted(x, start)) - 1, 0)
    last = len(x) if end is None else int(np.searchsorted(x, end, side="right")) + 1
    return slice(first, max(last, first))


def to_json(values: np.ndarray) -> list[float | None]:
    """Values as JSON, which has no nan: None."""
    found, is_finite = values.tolist(), np.isfinite(values)
    if is_finite.all():
        return found
    return [value if is_known else None for value, is_known in zip(found, is_finite.tolist(), strict=True)]
