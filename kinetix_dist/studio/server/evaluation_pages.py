"""HTTP API of evaluated levels: changes, what failing levels have in common, pictures, documents, training on them.

    GET api/runs/RUN/evaluations/levels                                   levels x evaluations, with changes
    GET api/runs/RUN/evaluations/features?set=NAME                        {size, names, features, groupings}
    GET api/runs/RUN/evaluations/thumbnails?set=NAME&indices=0,1          [{index, display, poses}]
    GET api/runs/RUN/evaluations/document?set=NAME&index=0&name=LEVEL     a level file
    GET api/runs/RUN/evaluations/archive?set=NAME&indices=0,1             level files as a zip
    GET api/runs/RUN/evaluations/finetune?set=NAME&indices=0,1            {lines, archive, has_checkpoint}

All but the first and the last need the engine worker, which builds the set again. Without indices `archive` and
`finetune` are of the whole set.
"""

from __future__ import annotations

import asyncio
import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aiohttp import web

from kinetix_dist.json_text import json_text
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.failure_groups import groups_of_set
from kinetix_dist.studio.runs.finetune_command import archive_stem, file_names, finetune_lines, has_checkpoint
from kinetix_dist.studio.runs.level_changes import policy_points, with_changes
from kinetix_dist.studio.server.level_pages import document_response, indices_of, thumbnails_response
from kinetix_dist.studio.server.responses import BadRequestError, json_response, number
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.worker_client import NO_WORKER, WorkerClient

FIRST_DATE = (1980, 1, 1, 0, 0, 0)  # of files in archives, so that the same levels give the same bytes


class EvaluationPages:
    """Handlers of `api/runs/{run}/evaluations/...`."""

    def __init__(self, service: RunService, worker: WorkerClient) -> None:
        self._service = service
        self._worker = worker

    def routes(self) -> list[web.RouteDef]:
        base = "/api/runs/{run}/evaluations"
        return [
            web.get(f"{base}/levels", self.levels),
            web.get(f"{base}/features", self.features),
            web.get(f"{base}/thumbnails", self.thumbnails),
            web.get(f"{base}/document", self.document),
            web.get(f"{base}/archive", self.archive),
            web.get(f"{base}/finetune", self.finetune),
        ]

    async def levels(self, request: web.Request) -> web.Response:
        """Levels x evaluations, see `level_changes.with_changes`."""
        path = self._path(request)
        return json_response(await asyncio.to_thread(lambda: with_changes(evaluations(path))))

    async def features(self, request: web.Request) -> web.Response:
        """Features of a set's levels, and groups by them with the solve rates of the newest evaluation.

        {problem} where the server has no engine worker.
        """
        path, name = self._path(request), _set_name(request)
        found = await asyncio.to_thread(_evaluated_set, path, name)
        if self._worker.is_off:  # as the page expects it there
            return json_response({"problem": NO_WORKER})
        built = await self.built_set(path, name, found["names"])
        groupings = await asyncio.to_thread(
            groups_of_set, name, found["names"], found["solved"], found["attempts"], built["features"]
        )
        return json_response({key: built[key] for key in ("size", "names", "features")} | {"groupings": groupings})

    async def built_set(self, path: Path, name: str, names: Sequence[str]) -> dict[str, Any]:
        """A set of a run {size, names, features}, built by the engine worker. Raises WorkerError.

        Raises BadRequestError where its levels have other names than when they were evaluated.
        """
        fields = {"run": str(path.resolve()), "set": name}
        built = (await self._worker.request("evaluation_set", fields)).content
        if built["names"] != names:
            raise BadRequestError(
                f"set {name} has other levels now than when the run was evaluated; restore them to see pictures of them"
            )
        return built

    async def thumbnails(self, request: web.Request) -> web.Response:
        indices = indices_of(request.query.get("indices", ""))
        reply = await self._worker.request("thumbnails", self._set(request) | {"indices": indices})
        return thumbnails_response(reply.body)

    async def document(self, request: web.Request) -> web.Response:
        """Download of a level as a file in our format."""
        name = request.query.get("name", "")
        level = self._set(request) | {"index": int(number(request.query, "index", 0, low=0)), "name": name}
        reply = await self._worker.request("document", {"level": level})
        [file] = file_names([name])
        return document_response(reply.content["document"], file)

    async def archive(self, request: web.Request) -> web.Response:
        """Level files of the named levels in one zip, that `finetune --levels` takes once it is unpacked."""
        found = await asyncio.to_thread(_evaluated_set, self._path(request), _set_name(request))
        indices = _chosen(request, len(found["names"]))
        reply = await self._worker.request("documents", self._set(request) | {"indices": indices})
        content = await asyncio.to_thread(_zipped, reply.body)
        stem = archive_stem(request.match_info["run"], _set_name(request), len(indices))
        response = web.Response(body=content, content_type="application/zip")
        response.headers["Content-Disposition"] = f'attachment; filename="{stem}.zip"'
        return response

    async def finetune(self, request: web.Request) -> web.Response:
        """Lines for a terminal that train on the named levels; `archive` is the file that they unpack, or null."""
        path, name = self._path(request), _set_name(request)

        def answer() -> dict[str, Any]:
            count = len(_evaluated_set(path, name)["names"])
            indices = _chosen(request, count)
            is_whole_set = len(set(indices)) == count
            stem = archive_stem(request.match_info["run"], name, len(indices))
            archive = None if is_whole_set else f"{stem}.zip"
            lines = finetune_lines(path, name if is_whole_set else stem, archive=archive)
            return {"lines": lines, "archive": archive, "has_checkpoint": has_checkpoint(path)}

        return json_response(await asyncio.to_thread(answer))

    def _path(self, request: web.Request) -> Path:
        return self._service.path_of(request.match_info["run"])

    def _set(self, request: web.Request) -> dict[str, Any]:
        """The set of a request as the engine worker calls it."""
        return {"run": str(self._path(request).resolve()), "set": _set_name(request)}


def _set_name(request: web.Request) -> str:
    name = request.query.get("set", "")
    if not name:
        raise BadRequestError("set is missing; name an evaluation set of the run")
    return name


def _chosen(request: web.Request, count: int) -> list[int]:
    """Indices of a request into the levels of a set; all of them where it names none."""
    indices = indices_of(request.query.get("indices", ""))
    if any(index >= count for index in indices):
        raise BadRequestError(f"indices has {max(indices)}; the set has levels 0 to {count - 1}")
    return indices or list(range(count))


def _evaluated_set(path: Path, name: str) -> dict[str, Any]:
    """Names and newest counts {names, solved, attempts} of a set. Raises BadRequestError where there are none."""
    found = evaluations(path)["sets"].get(name)
    numbers = policy_points(found["points"]) if found is not None and found["names"] is not None else []
    if found is None or not numbers:
        raise BadRequestError(f"this run has no evaluation of single levels of {name!r}")
    newest = found["points"][numbers[-1]]
    return {"names": found["names"], "solved": newest["solved"], "attempts": newest["attempts"]}


def _zipped(body: bytes) -> bytes:
    """Archive of the documents of a reply: [[name, document], ...] as JSON."""
    entries = json.loads(body)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, (_, document) in zip(file_names([name for name, _ in entries]), entries, strict=True):
            archive.writestr(zipfile.ZipInfo(file, FIRST_DATE), json_text(document, indent=2))
    return content.getvalue()
