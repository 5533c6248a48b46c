"""`api/compare`: curves of several runs on one axis, groups with bands, and what differs between their configs."""

from __future__ import annotations

import asyncio
from typing import Any

from aiohttp import web

from kinetix_dist.studio.runs.compare import STATISTICS, config_differences, flat_config, group_by, group_curve
from kinetix_dist.studio.runs.run_files import RunFileError, read_config
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.studio.runs.series import AXES, AxisError, axis_values, decimate, to_json
from kinetix_dist.studio.server.answers import BadRequestError, json_response, number
from kinetix_dist.studio.server.run_service import RunService

MAX_RUNS = 100
DEFAULT_POINTS = 300
MAX_POINTS = 5000


class ComparePages:
    """Handler of `api/compare?runs=a,b&metric=..&x=..&group=ppo.clip&statistic=iqm&points=300`."""

    def __init__(self, service: RunService) -> None:
        self._service = service

    def routes(self) -> list[web.RouteDef]:
        return [web.get("/api/compare", self.compare)]

    async def compare(self, request: web.Request) -> web.Response:
        query = request.query
        names = [name for name in query.get("runs", "").split(",") if name]
        axis, statistic = query.get("x", "env_steps"), query.get("statistic", "mean")
        points = int(number(query, "points", DEFAULT_POINTS, low=2, high=MAX_POINTS))
        if not names or len(names) > MAX_RUNS:
            raise BadRequestError(f"{len(names)} runs are named; name 1 to {MAX_RUNS}")
        if statistic not in STATISTICS:
            raise BadRequestError(f"statistic {statistic!r} is none of {', '.join(STATISTICS)}")
        if axis not in AXES:
            raise BadRequestError(f"axis {axis!r} is none of {', '.join(AXES)}")
        readers = {name: await self._service.reader(name) for name in names}
        metric, group = query.get("metric", ""), query.get("group", "")
        return json_response(await asyncio.to_thread(_compare, readers, metric, axis, group, statistic, points))


def _compare(
    readers: dict[str, RunReader], metric: str, axis: str, group: str, statistic: str, points: int
) -> dict[str, Any]:
    problems: list[str] = []
    configs: dict[str, dict[str, Any]] = {}
    raw: dict[str, Any] = {}
    metrics: dict[str, None] = {}
    for name, reader in readers.items():
        try:
            configs[name] = read_config(reader.path)
        except RunFileError as error:
            configs[name] = {}
            problems.append(f"{name}: {error}")
        with reader.lock:
            metrics |= dict.fromkeys(reader.table.names)
            try:
                x = axis_values(reader.table, axis, reader.anchors())
            except AxisError as error:
                problems.append(f"{name}: {error}")
                continue
            if metric and metric not in reader.table.names:
                problems.append(f"{name} has no {metric}")
            elif metric:
                raw[name] = (x.copy(), reader.table.column(metric).copy())
    groups = group_by(configs, group)
    answer_groups = []
    for value, members in groups.items():
        curve = group_curve([raw[name] for name in members if name in raw], statistic=statistic, points=points)
        answer_groups.append(
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
    curves = {}
    for name, (x, y) in raw.items():
        curve = decimate(x, y, points=points)
        curves[name] = {"x": to_json(curve.x), "mean": to_json(curve.mean)}
    return {
        "axis": axis,
        "unit": AXES[axis][1],
        "metrics": list(metrics),
        "runs": curves,
        "groups": answer_groups,
        "differences": config_differences(configs),
        "fields": sorted({field for config in configs.values() for field in flat_config(config)}),
        "problems": problems,
    }
