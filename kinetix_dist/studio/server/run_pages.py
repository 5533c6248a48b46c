"""HTTP API of runs: JSON, read from run directories when it is requested."""

from __future__ import annotations

import asyncio
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import web

from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.processes import Processes
from kinetix_dist.studio.runs.run_files import RunFileError, read_object
from kinetix_dist.studio.runs.run_index import status_of
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.studio.runs.series import AXES, AxisError, axis_values, decimate, select, to_json
from kinetix_dist.studio.server.responses import json_response, number
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.verdict_summaries import VerdictSummaries
from kinetix_dist.telemetry.names import UnknownMetricError, describe
from kinetix_dist.telemetry.sections import NORMAL, SECTIONS, section_of

MAX_POINTS = 20_000
DEFAULT_POINTS = 1500


class RunPages:
    """Handlers of `api/runs...`."""

    def __init__(self, service: RunService, verdicts: VerdictSummaries) -> None:
        self._service = service
        self._verdicts = verdicts
        self._processes: dict[Path, Processes] = {}

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/api/runs", self.runs),
            web.get("/api/runs/{run}", self.run),
            web.get("/api/runs/{run}/series", self.series),
            web.get("/api/runs/{run}/events", self.events),
            web.get("/api/runs/{run}/evaluations", self.evaluations),
            web.get("/api/runs/{run}/processes", self.processes),
        ]

    async def runs(self, request: web.Request) -> web.Response:
        """Summaries, see `run_index.summary`, with `verdict` {outcome, rank, state, heading}; null: not judged yet."""
        found = await self._service.summaries()
        verdicts = await self._verdicts.of(found)
        rows = [row | {"verdict": verdict} for row, verdict in zip(found, verdicts, strict=True)]
        return json_response({"runs": rows, "problems": self._service.index.problems})

    async def run(self, request: web.Request) -> web.Response:
        """Config, status, report, and the metrics of the run with unit and meaning."""
        run_id = request.match_info["run"]
        reader = await self._service.reader(run_id)
        return json_response({"id": run_id} | await asyncio.to_thread(_describe_run, reader))

    async def series(self, request: web.Request) -> web.Response:
        """Curves: ?names=a,b&x=env_steps&points=1500&from=&to=. A page sends `rows` and `revision` back in `watch`."""
        reader = await self._service.reader(request.match_info["run"])
        query = request.query
        names = [name for name in query.get("names", "").split(",") if name]
        points = int(number(query, "points", DEFAULT_POINTS, low=1, high=MAX_POINTS))
        start, end = number(query, "from"), number(query, "to")
        axis = query.get("x", "env_steps")

        def answer() -> dict[str, Any]:
            with reader.lock:
                return _curves(reader, names, axis, points, start, end)

        return json_response(await asyncio.to_thread(answer))

    async def events(self, request: web.Request) -> web.Response:
        """Events of a run; ?after=N leaves out the first N."""
        reader = await self._service.reader(request.match_info["run"])
        after = int(number(request.query, "after", 0, low=0))
        return json_response({"count": len(reader.events), "events": reader.events[after:]})

    async def evaluations(self, request: web.Request) -> web.Response:
        path = self._service.path_of(request.match_info["run"])
        return json_response(await asyncio.to_thread(evaluations, path))

    async def processes(self, request: web.Request) -> web.Response:
        """Processes of a run, see `processes.Processes.describe`."""
        reader = await self._service.reader(request.match_info["run"])
        processes = self._processes.setdefault(reader.path, Processes(reader.path))
        return json_response(await asyncio.to_thread(processes.describe, reader.events))


def _describe_run(reader: RunReader) -> dict[str, Any]:
    path, problems = reader.path, []

    def read(name: str) -> dict[str, Any] | None:
        try:
            return read_object(path / name)
        except RunFileError as error:
            problems.append(str(error))
            return None

    status = status_of(path)
    problems += [status.problem] if status.problem is not None else []
    with reader.lock:
        problems += reader.problems.values()
        return {
            "path": str(path),
            "status": dataclasses.asdict(status),
            "config": read(run_files.CONFIG),
            "report": read(run_files.REPORT),
            "metrics": {name: _describe_metric(name) for name in reader.table.names},
            "sections": list(SECTIONS),
            "problems": problems,
            "rows": reader.table.num_rows,
        }


def _describe_metric(name: str) -> dict[str, Any]:
    """Unit, meaning, section and normal range of a metric; one of a plugin or another version is not described."""
    try:
        metric = describe(name)
        described = {"unit": metric.unit, "meaning": metric.meaning}
    except UnknownMetricError:
        described = {"unit": "", "meaning": "not described in this version"}
    normal = dataclasses.asdict(NORMAL[name]) if name in NORMAL else None
    return described | {"section": section_of(name), "normal": normal}


def _curves(
    reader: RunReader, names: list[str], axis: str, points: int, start: float | None, end: float | None
) -> dict[str, Any]:
    table = reader.table
    missing = [name for name in names if name not in table.names]
    answer: dict[str, Any] = {
        "rows": table.num_rows,
        "revision": reader.revision,
        "axis": axis,
        "unit": AXES[axis][1] if axis in AXES else "",
        "missing": missing,
    }
    if not table.num_rows:
        if axis not in AXES:
            raise AxisError(f"axis {axis!r} is none of {', '.join(AXES)}")
        return answer | {"x": [], "series": {}, "breaks": [], "events": []}
    x = axis_values(table, axis, reader.anchors())
    chosen = select(x, start, end)
    series, curve_x = {}, decimate(x[chosen], x[chosen], points=points).x
    for name in names:
        if name not in missing:
            curve = decimate(x[chosen], table.column(name)[chosen], points=points)
            series[name] = {"mean": to_json(curve.mean)}
            if curve.low is not curve.mean:
                series[name] |= {"min": to_json(curve.low), "max": to_json(curve.high)}
    return answer | {"x": to_json(curve_x), "series": series, "events": _events_on_axis(reader, x)}


def _events_on_axis(reader: RunReader, x: np.ndarray) -> list[dict[str, Any]]:
    """Events that have an update, at its x on the axis."""
    updates = reader.table.column("update")
    found = []
    for number_of_event, event in enumerate(reader.events):
        update = event.get("update")
        if isinstance(update, int):
            row = min(int(np.searchsorted(updates, update)), len(x) - 1)
            if np.isfinite(x[row]):
                found.append({"x": float(x[row]), "event": event["event"], "number": number_of_event})
    return found
