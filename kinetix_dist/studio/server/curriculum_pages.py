"""What pages ask of a run's curriculum: `api/runs/RUN/curriculum`, and levels of its snapshots."""

from __future__ import annotations

import asyncio
from pathlib import Path

from aiohttp import web

from kinetix_dist.studio.runs.level_history import level_history
from kinetix_dist.studio.runs.levels import level_page
from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.studio.server.answers import json_response, number
from kinetix_dist.studio.server.run_service import RunService, UnknownRunError
from kinetix_dist.telemetry.curriculum_log import REFRESH

LEVELS_A_PAGE = 96
MAX_LEVELS_A_PAGE = 4096
SNAPSHOT = "{kind:refresh|buffer}/{number:[0-9]+}"


class CurriculumPages:
    """Handlers of `api/runs/{run}/curriculum...`. Summaries of files are kept while a file is the same."""

    def __init__(self, service: RunService) -> None:
        self._service = service
        self._refreshes: dict[Path, Refreshes] = {}

    def routes(self) -> list[web.RouteDef]:
        base = "/api/runs/{run}/curriculum"
        return [
            web.get(base, self.curriculum),
            web.get(f"{base}/{SNAPSHOT}/levels", self.levels),
            web.get(f"{base}/{SNAPSHOT}/levels/{{index:[0-9]{{1,8}}}}/history", self.history),
        ]

    async def curriculum(self, request: web.Request) -> web.Response:
        """See `dashboard.refreshes.Refreshes.summaries`."""
        return json_response(await asyncio.to_thread(self._of(request).summaries))

    async def levels(self, request: web.Request) -> web.Response:
        """?sort=score&order=down&filter=joints>=1&offset=0&limit=96, see `dashboard.levels.level_page`."""
        query, refreshes = request.query, self._of(request)
        kind, snapshot_number = request.match_info["kind"], int(request.match_info["number"])
        offset = int(number(query, "offset", 0, low=0))
        limit = int(number(query, "limit", LEVELS_A_PAGE, low=1, high=MAX_LEVELS_A_PAGE))

        def answer() -> dict:
            try:
                snapshot = refreshes.snapshot(kind, snapshot_number)
            except (KeyError, FileNotFoundError):
                raise UnknownRunError(f"there is no {kind} {snapshot_number} in this run (any more)") from None
            plays = refreshes.plays(snapshot_number) if kind == REFRESH else None
            return level_page(
                snapshot,
                plays,
                sort=query.get("sort", "place"),
                descending=query.get("order", "up") == "down",
                filter_text=query.get("filter", ""),
                offset=offset,
                limit=limit,
            )

        return json_response(await asyncio.to_thread(answer))

    async def history(self, request: web.Request) -> web.Response:
        """See `dashboard.level_history.level_history`; with `problems`."""
        info, refreshes = request.match_info, self._of(request)
        kind, snapshot_number, index = info["kind"], int(info["number"]), int(info["index"])

        def answer() -> dict:
            snapshots, windows, problems = refreshes.read()
            try:
                found = level_history(snapshots, windows, kind, snapshot_number, index)
            except (KeyError, IndexError):
                text = f"there is no level {index} of {kind} {snapshot_number} in this run (any more)"
                raise UnknownRunError(text) from None
            return found | {"problems": problems}

        return json_response(await asyncio.to_thread(answer))

    def _of(self, request: web.Request) -> Refreshes:
        path = self._service.path_of(request.match_info["run"])
        return self._refreshes.setdefault(path, Refreshes(path))
