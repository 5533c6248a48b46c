"""Metrics as columns: rows that come late, go back or lack a metric; curves with few points; axes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kinetix_dist.studio.runs.series import AxisError, SeriesTable, axis_values, decimate, select


def table_of(*rows: dict) -> SeriesTable:
    table = SeriesTable()
    table.append(rows)
    return table


def test_rows_become_columns_with_nan_where_a_metric_is_missing() -> None:
    table = table_of({"update": 1, "a": 2.0}, {"update": 2, "b": None, "a": 3}, {"update": 3, "b": 5.0})
    assert table.names == ["a", "b"]
    np.testing.assert_array_equal(table.column("a"), [2, 3, np.nan])
    np.testing.assert_array_equal(table.column("b"), [np.nan, np.nan, 5])
    assert table.rows(1) == {"update": [2.0, 3.0], "a": [3.0, None], "b": [None, 5.0]}
    assert np.isnan(table.column("unknown")).all()


def test_a_row_of_an_earlier_update_removes_what_is_later() -> None:
    table = table_of(*({"update": k, "a": float(k)} for k in range(1, 11)))
    assert table.append([{"update": 8, "b": 1.0}, {"update": 9}]) == 7
    np.testing.assert_array_equal(table.column("update"), range(1, 10))
    np.testing.assert_array_equal(table.column("a"), [1, 2, 3, 4, 5, 6, 7, np.nan, np.nan])


def test_a_table_grows() -> None:
    table = SeriesTable()
    for k in range(2000):
        assert table.append([{"update": k, "a": k} | ({"late": k} if k > 999 else {})]) == k
    assert table.column("a").sum() == sum(range(2000))
    assert np.isnan(table.column("late")[:1000]).all() and table.column("late")[1999] == 1999


@pytest.mark.parametrize("count", [0, 1, 7, 10, 11, 99, 1000])
def test_a_curve_of_few_points_keeps_extremes_and_means(count: int) -> None:
    chance = np.random.default_rng(count)
    y = np.where(chance.random(count) < 0.2, np.nan, chance.normal(size=count))
    x = np.arange(count, dtype=float)
    curve = decimate(x, y, points=10)
    assert len(curve.x) <= 10
    size = math.ceil(count / 10) or 1
    for k in range(len(curve.x)):
        part = [value for value in y[k * size : (k + 1) * size].tolist() if not math.isnan(value)]
        assert curve.x[k] == x[k * size : (k + 1) * size][-1]
        if not part:
            assert np.isnan([curve.low[k], curve.high[k], curve.mean[k]]).all()
        else:
            found = (curve.low[k], curve.high[k], curve.mean[k])
            assert found == pytest.approx((min(part), max(part), sum(part) / len(part)))


def test_the_date_of_a_row_follows_from_events_and_seconds() -> None:
    """A run of two sessions: updates take 10 s; a day passes between update 3 and the session that goes on."""
    table = table_of(*({"update": k, "progress/seconds": 10.0 * k} for k in range(1, 7)))
    day = 86400.0
    times = axis_values(table, "time", [(0, 1000.0), (3, 1000.0 + day)])
    np.testing.assert_allclose(times, [1010, 1020, 1000 + day, 1010 + day, 1020 + day, 1030 + day])


def test_axes_that_cannot_be_are_refused_in_one_line() -> None:
    table = table_of({"update": 1})
    with pytest.raises(AxisError, match="none of env_steps"):
        axis_values(table, "weeks")
    with pytest.raises(AxisError, match="have no progress/env_steps"):
        axis_values(table, "env_steps")
    with pytest.raises(AxisError, match="no event"):
        axis_values(table, "time")


def test_a_zoom_has_a_row_beyond_its_edges() -> None:
    x = np.arange(10.0)
    assert select(x, 3.5, 5.5) == slice(3, 7)
    assert select(x, None, None) == slice(0, 10)
    assert x[select(x, 20, 30)].tolist() == [9.0]
