"""HTTP API of verdicts, computed from run directories when they are requested.

    GET api/runs/RUN/verdict            {state, word, heading, next, statements, problems}
    GET api/runs/RUN/verdict/failing    {statements}: what fails, by features of the levels

The second one waits for the engine worker where it has not built the sets of the run yet.
"""

from __future__ import annotations

import asyncio
import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from aiohttp import web

from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.processes import Processes
from kinetix_dist.studio.runs.verdict import verdict_of
from kinetix_dist.studio.runs.verdict_failing import Features, failing_statement, sets_with_counts
from kinetix_dist.studio.runs.verdict_sets import SetHistory, set_histories
from kinetix_dist.studio.server.evaluation_pages import EvaluationPages
from kinetix_dist.studio.server.level_pages import CurriculumPages
from kinetix_dist.studio.server.responses import BadRequestError, json_response
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.worker_client import WorkerError

ASK_AGAIN_S = 300.0  # for a set that could not be built: a page of a run that goes on asks every 15 s


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Asked:
    """Answer of the engine worker about a set."""

    levels: Sequence[str]  # their names, when it was asked
    features: Features | None = None
    problem: str = ""
    until: float = math.inf  # monotonic s


class VerdictPages:
    """Handlers of `api/runs/{run}/verdict...`."""

    def __init__(self, service: RunService, curricula: CurriculumPages, evaluated: EvaluationPages) -> None:
        """curricula: whose readers of snapshots are used, so that a file is read once. evaluated: builds sets."""
        self._service = service
        self._curricula = curricula
        self._evaluated = evaluated
        self._processes: dict[Path, Processes] = {}
        self._features: dict[tuple[Path, str], _Asked] = {}  # by run and set

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/api/runs/{run}/verdict", self.verdict),
            web.get("/api/runs/{run}/verdict/failing", self.failing),
        ]

    async def verdict(self, request: web.Request) -> web.Response:
        """Verdict, see `verdict.Verdict`."""
        reader = await self._service.reader(request.match_info["run"])
        processes = self._processes.setdefault(reader.path, Processes(reader.path))
        refreshes = self._curricula.refreshes_of(reader.path)
        verdict = await asyncio.to_thread(verdict_of, reader, refreshes, processes)
        return json_response(verdict.to_json())

    async def failing(self, request: web.Request) -> web.Response:
        """Statement on what fails, in a list that is empty without counts of levels."""
        path = self._service.path_of(request.match_info["run"])
        histories = await asyncio.to_thread(lambda: set_histories(evaluations(path)))
        features, problems = await self._features_of(path, histories)
        found = await asyncio.to_thread(failing_statement, histories, features, problems)
        return json_response({"statements": [statement.to_json() for statement in found]})

    async def _features_of(
        self, path: Path, histories: Sequence[SetHistory]
    ) -> tuple[Mapping[str, Features], Mapping[str, str]]:
        """Features of the sets, and why those of others are not known. A set is built once per server and run."""
        features: dict[str, Features] = {}
        problems: dict[str, str] = {}
        for one in sets_with_counts(histories):
            assert one.levels is not None
            key = (path, one.name)
            known = self._features.get(key)
            if known is None or known.levels != one.levels or known.until < time.monotonic():
                known = self._features[key] = await self._ask(path, one.name, one.levels)
            if known.features is None:
                problems[one.name] = known.problem
            else:
                features[one.name] = known.features
        return features, problems

    async def _ask(self, path: Path, name: str, levels: Sequence[str]) -> _Asked:
        try:
            built = await self._evaluated.built_set(path, name, levels)
        except (WorkerError, BadRequestError) as error:
            return _Asked(levels=levels, problem=str(error), until=time.monotonic() + ASK_AGAIN_S)
        return _Asked(levels=levels, features=built["features"])
