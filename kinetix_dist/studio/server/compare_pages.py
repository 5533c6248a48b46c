"""HTTP API of comparisons between runs: curves of metrics and of held-out solve rates, a table, differing configs."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from aiohttp import web

from kinetix_dist.studio.runs.compare import STATISTICS, config_differences, flat_config, group_by, group_curve
from kinetix_dist.studio.runs.compared_rates import (
    RateCurve,
    baselines,
    metric_of,
    other_levels,
    rate_curve,
    run_rows,
    set_of,
)
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.run_files import RunFileError, read_config
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.studio.runs.series import AXES, AxisError, axis_values, decimate, to_json
from kinetix_dist.studio.server.responses import BadRequestError, json_response, number
from kinetix_dist.studio.server.run_service import RunService

MAX_RUNS = 100
MAX_METRICS = 50
MAX_POINTS = 5000
DEFAULT_POINTS = 300
METRIC_WITHOUT_EVALUATIONS = "train/solve_rate"  # shown at first where no run was evaluated


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Choices of a page: metrics (none: solve rates of all evaluation sets), axis, and how runs are put together."""

    metrics: tuple[str, ...]
    axis: str
    group: str
    statistic: str
    points: int


class ComparePages:
    """Handler of `api/compare?runs=a,b&metric=a,b&x=..&group=ppo.clip&statistic=iqm&points=300`."""

    def __init__(self, service: RunService) -> None:
        self._service = service

    def routes(self) -> list[web.RouteDef]:
        return [web.get("/api/compare", self.compare)]

    async def compare(self, request: web.Request) -> web.Response:
        query = request.query
        names = [*dict.fromkeys(name for name in query.get("runs", "").split(",") if name)]
        view = View(
            metrics=tuple(name for name in query.get("metric", "").split(",") if name),
            axis=query.get("x", "env_steps"),
            group=query.get("group", ""),
            statistic=query.get("statistic", "mean"),
            points=int(number(query, "points", DEFAULT_POINTS, low=2, high=MAX_POINTS)),
        )
        if not names or len(names) > MAX_RUNS:
            raise BadRequestError(f"{len(names)} runs are named; name 1 to {MAX_RUNS}")
        if len(view.metrics) > MAX_METRICS:
            raise BadRequestError(f"{len(view.metrics)} metrics are named; name {MAX_METRICS} at most")
        if view.statistic not in STATISTICS:
            raise BadRequestError(f"statistic {view.statistic!r} is none of {', '.join(STATISTICS)}")
        if view.axis not in AXES:
            raise BadRequestError(f"axis {view.axis!r} is none of {', '.join(AXES)}")
        readers = {name: await self._service.reader(name) for name in names}
        return json_response(await asyncio.to_thread(_compare, readers, view))


def _compare(readers: Mapping[str, RunReader], view: View) -> dict[str, Any]:
    problems: list[str] = []
    configs: dict[str, dict[str, Any]] = {}
    sets: dict[str, dict[str, Any]] = {}  # of each run, those of `evaluations`
    unreadable: dict[str, str] = {}
    for run, reader in readers.items():
        try:
            configs[run] = read_config(reader.path)
        except RunFileError as error:
            configs[run] = {}
            problems.append(f"{run}: {error}")
        try:
            found = evaluations(reader.path)
            sets[run] = found["sets"]
            problems += [f"{run}: {problem}" for problem in found["problems"]]
        except RunFileError as error:
            sets[run], unreadable[run] = {}, str(error)
            problems.append(f"{run}: {error}")
    problems += other_levels(sets)
    set_names = [*dict.fromkeys(name for entries in sets.values() for name in entries)]
    metrics = dict.fromkeys(map(metric_of, set_names))
    rows: list[dict[str, Any]] = []
    reasons: dict[str, str] = {}  # of runs without any evaluation
    for run, reader in readers.items():
        with reader.lock:
            # Rates in rows of metrics come from the same evaluations, without their counts.
            metrics |= dict.fromkeys(name for name in reader.table.names if set_of(name) is None)
            rows_of_run = run_rows(run, configs[run], sets[run], reader.table, unreadable.get(run))
        rows += rows_of_run
        if not sets[run]:
            reasons[run] = rows_of_run[0]["reason"]
    chosen = view.metrics or tuple(map(metric_of, set_names)) or (METRIC_WITHOUT_EVALUATIONS,)
    curves = {}
    for metric in chosen:
        set_name = set_of(metric)
        if set_name is None:
            curves[metric] = _curves_of_metric(readers, configs, metric, view)
        else:
            of_set = {run: entries[set_name] for run, entries in sets.items() if set_name in entries}
            curves[metric] = _curves_of_set(readers, configs, of_set, view)
            for run in readers:
                if run not in of_set:
                    curves[metric]["missing"][run] = reasons.get(run, f"not evaluated on {set_name}")
    return {
        "axis": view.axis,
        "unit": AXES[view.axis][1],
        "sets": set_names,
        "metrics": list(metrics),
        "curves": curves,
        "rows": rows,
        "differences": config_differences(configs),
        "fields": sorted({field for config in configs.values() for field in flat_config(config)}),
        "problems": problems,
    }


def _curves_of_metric(
    readers: Mapping[str, RunReader], configs: Mapping[str, dict[str, Any]], metric: str, view: View
) -> dict[str, Any]:
    raw: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    missing = {}
    for run, reader in readers.items():
        with reader.lock:
            try:
                x = axis_values(reader.table, view.axis, reader.anchors())
            except AxisError as error:
                missing[run] = str(error)
                continue
            if metric in reader.table.names:
                raw[run] = (x.copy(), reader.table.column(metric).copy())
            else:
                missing[run] = f"no {metric}"
    runs = {}
    for run, (x, y) in raw.items():
        curve = decimate(x, y, points=view.points)
        runs[run] = {"x": to_json(curve.x), "mean": to_json(curve.mean)}
    return {"runs": runs, "missing": missing, "groups": _groups(configs, raw, view), "baselines": []}


def _curves_of_set(
    readers: Mapping[str, RunReader],
    configs: Mapping[str, dict[str, Any]],
    sets: Mapping[str, Mapping[str, Any]],
    view: View,
) -> dict[str, Any]:
    found: dict[str, RateCurve] = {}
    missing = {}
    for run, entry in sets.items():
        reader = readers[run]
        with reader.lock:
            try:
                curve = rate_curve(entry["points"], view.axis, reader.table, reader.anchors())
            except AxisError as error:
                missing[run] = str(error)
                continue
        if len(curve.x):
            found[run] = curve
        else:
            missing[run] = "no evaluation of its policy has a place on this axis"
    runs = {
        run: {
            "x": to_json(curve.x),
            "mean": to_json(curve.rate),
            "low": to_json(curve.low),
            "high": to_json(curve.high),
            "episodes": curve.episodes.tolist(),
        }
        for run, curve in found.items()
    }
    raw = {run: (curve.x, curve.rate) for run, curve in found.items()}
    return {
        "runs": runs,
        "missing": missing,
        "groups": _groups(configs, raw, view),
        "baselines": baselines(sets, configs),
    }


def _groups(
    configs: Mapping[str, dict[str, Any]], raw: Mapping[str, tuple[np.ndarray, np.ndarray]], view: View
) -> list[dict[str, Any]]:
    groups = []
    for value, members in group_by(configs, view.group).items():
        curves: Sequence[tuple[np.ndarray, np.ndarray]] = [raw[run] for run in members if run in raw]
        curve = group_curve(curves, statistic=view.statistic, points=view.points)
        groups.append(
            {
                "value": value,
                "runs": members,
                "x": to_json(curve.x),
                "center": to_json(curve.center),
                "low": to_json(curve.low),
                "high": to_json(curve.high),
                "num_runs": curve.num_runs.tolist(),
            }
        )
    return groups
