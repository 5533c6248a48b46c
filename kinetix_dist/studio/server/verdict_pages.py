"""HTTP API of verdicts: `api/runs/{run}/verdict`, computed from run directories when it is requested."""

from __future__ import annotations

import asyncio
from pathlib import Path

from aiohttp import web

from kinetix_dist.studio.runs.processes import Processes
from kinetix_dist.studio.runs.verdict import verdict_of
from kinetix_dist.studio.server.level_pages import CurriculumPages
from kinetix_dist.studio.server.responses import json_response
from kinetix_dist.studio.server.run_service import RunService


class VerdictPages:
    """Handler of `api/runs/{run}/verdict`."""

    def __init__(self, service: RunService, curricula: CurriculumPages) -> None:
        """curricula: whose readers of snapshots are used, so that a file is read once."""
        self._service = service
        self._curricula = curricula
        self._processes: dict[Path, Processes] = {}

    def routes(self) -> list[web.RouteDef]:
        return [web.get("/api/runs/{run}/verdict", self.verdict)]

    async def verdict(self, request: web.Request) -> web.Response:
        """Verdict {state, heading, statements: [{key, title, state, sentence, remedy, page, query}], problems}."""
        reader = await self._service.reader(request.match_info["run"])
        processes = self._processes.setdefault(reader.path, Processes(reader.path))
        refreshes = self._curricula.refreshes_of(reader.path)
        verdict = await asyncio.to_thread(verdict_of, reader, refreshes, processes)
        return json_response(verdict.to_json())
