"""HTTP API of levels, curricula and recordings of runs. The engine worker draws and decodes levels and rollouts.

Files are named by run and name. A name that is no plain file name, or leads out of its run, is not found.
"""

from __future__ import annotations

import asyncio
import json
import struct
from pathlib import Path
from typing import Any

from aiohttp import web

from kinetix_dist.json_text import json_text
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.address_names import address_name
from kinetix_dist.studio.runs.first_buffer import first_buffer, first_outcomes, next_probe
from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.studio.runs.run_index import status_of
from kinetix_dist.studio.runs.snapshot_levels import level_history, level_page
from kinetix_dist.studio.server.responses import (
    COMPRESS_FROM_BYTES,
    BadRequestError,
    error_response,
    json_response,
    number,
)
from kinetix_dist.studio.server.run_service import RunService, UnknownRunError
from kinetix_dist.studio.server.worker_client import OFF, WorkerClient, WorkerError
from kinetix_dist.studio.worker.wire import BAD_REQUEST, BUSY, NOT_FOUND, TOO_LARGE
from kinetix_dist.telemetry.curriculum_log import REFRESH
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row

MAX_THUMBNAILS = 1024  # of one request
STATUS_OF_CODE = {BAD_REQUEST: 400, NOT_FOUND: 404, TOO_LARGE: 413, BUSY: 503, OFF: 503}


class LevelPages:
    """Handlers of `api/runs/{run}/recordings...` and of pictures and documents of levels."""

    def __init__(self, service: RunService, worker: WorkerClient) -> None:
        self._service = service
        self._worker = worker

    def routes(self) -> list[web.RouteDef]:
        snapshot = "/api/runs/{run}/curriculum/{kind:refresh|buffer}/{number:[0-9]{1,8}}"
        return [
            web.get("/api/palette", self.palette),
            web.get(f"{snapshot}/thumbnails", self.thumbnails),
            web.get(f"{snapshot}/levels/{{index:[0-9]{{1,8}}}}/document", self.document),
            web.get("/api/runs/{run}/recordings", self.recordings),
            web.get("/api/runs/{run}/recordings/{file}/{index:[0-9]{1,8}}", self.recording),
        ]

    async def palette(self, request: web.Request) -> web.Response:
        """Colours and lengths of pictures, see jax2d/palette.py."""
        return json_response((await self._worker.hello())["palette"])

    async def thumbnails(self, request: web.Request) -> web.Response:
        """Pictures of levels: ?indices=0,1,2 gives [{index, display, poses}]."""
        indices = indices_of(request.query.get("indices", ""))
        kind = request.match_info["kind"]
        fields = {
            "run": str(self._service.path_of(request.match_info["run"])),
            kind: int(request.match_info["number"]),
            "indices": indices,
        }
        reply = await self._worker.request("thumbnails", fields)
        return thumbnails_response(reply.body)

    async def document(self, request: web.Request) -> web.Response:
        """Download of a level as a file in our format."""
        info = request.match_info
        level = {"run": str(self._service.path_of(info["run"])), info["kind"]: int(info["number"])}
        reply = await self._worker.request("document", {"level": {**level, "index": int(info["index"])}})
        name = f"{info['run']}_{info['kind']}_{int(info['number'])}_{int(info['index'])}.json"
        return document_response(reply.content["document"], name)

    async def recordings(self, request: web.Request) -> web.Response:
        """Recordings {files: [{file, path, bytes, modified, rollouts, problems}]}, newest first."""
        run = self._service.path_of(request.match_info["run"])
        files = await asyncio.to_thread(recording_files, run)
        listed = []
        for path in files:
            entry: dict[str, Any] = {"file": address_name(path.name), "path": str(path)}
            try:
                status = path.stat()
                entry |= {"bytes": status.st_size, "modified": status.st_mtime}
                reply = await self._worker.request("recordings", {"file": str(path)})
                entry |= {"rollouts": reply.content["rollouts"], "problems": reply.content["problems"]}
            except (WorkerError, OSError) as error:
                if isinstance(error, WorkerError) and error.code == OFF:
                    raise
                entry |= {"rollouts": [], "problems": [str(error)]}
            listed.append(entry)
        return json_response({"files": listed})

    async def recording(self, request: web.Request) -> web.Response:
        """Rollout: u32 size of the JSON | JSON as in docs/play_protocol.md | float32 arrays; all little-endian."""
        path = recording_path(self._service.path_of(request.match_info["run"]), request.match_info["file"])
        fields = {"file": str(path), "index": int(request.match_info["index"])}
        reply = await self._worker.request("recording", fields)
        about = {name: value for name, value in reply.content.items() if name not in ("type", "id")}
        text = json.dumps(about, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)  # so that the arrays lie at multiples of four bytes
        body = struct.pack("<I", len(text)) + text + reply.body
        response = web.Response(body=body, content_type="application/octet-stream")
        response.enable_compression()
        return response


def recording_files(run: Path) -> list[Path]:
    """Recordings that lie in the directory of a run, newest first."""
    folder = run / run_files.RECORDINGS
    try:
        found = [path for path in folder.iterdir() if path.suffix == ".mcap" and not path.name.startswith(".")]
        inside = [path for path in found if is_inside(path, run) and path.is_file()]
        return sorted(inside, key=lambda path: path.stat().st_mtime_ns, reverse=True)
    except OSError:  # no such folder, or a file was removed meanwhile: the next request lists what is left
        return []


def recording_path(run: Path, name: str) -> Path:
    """Return the path of a recording that a page names. Raises UnknownRunError if the run has none of that name."""
    for path in recording_files(run):
        if address_name(path.name) == name:
            return path
    raise UnknownRunError(f"there is no recording {name!r} in this run (any more)")


def is_inside(path: Path, run: Path) -> bool:
    """True where a path, links followed, lies in a run directory."""
    return path.resolve().is_relative_to(run.resolve())


def worker_error_response(error: WorkerError) -> web.Response:
    """One-line response with the HTTP status of the error's code."""
    return error_response(STATUS_OF_CODE.get(error.code, 502), str(error))


def thumbnails_response(body: bytes) -> web.Response:
    """Pictures of levels as the engine worker sends them, JSON."""
    response = web.Response(body=body, content_type="application/json", charset="utf-8")
    if len(body) >= COMPRESS_FROM_BYTES:
        response.enable_compression()
    return response


def document_response(document: dict[str, Any], name: str) -> web.Response:
    """Download of a level file."""
    response = web.Response(text=json_text(document, indent=2), content_type="application/json")
    response.headers["Content-Disposition"] = f'attachment; filename="{name.encode("ascii", "replace").decode()}"'
    return response


def indices_of(text: str) -> list[int]:
    parts = text.split(",") if text else []
    if not all(part.isascii() and part.isdigit() and len(part) < 9 for part in parts) or len(parts) > MAX_THUMBNAILS:
        raise BadRequestError(f"indices is {text[:40]!r}; give up to {MAX_THUMBNAILS} numbers, as 0,1,2")
    return [int(part) for part in parts]


LEVELS_PER_PAGE = 96
MAX_LEVELS_PER_PAGE = 4096
SNAPSHOT = "{kind:refresh|buffer}/{number:[0-9]{1,8}}"


class CurriculumPages:
    """Handlers of `api/runs/{run}/curriculum...`. Summaries are cached until a file changes."""

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
        """Summaries of all snapshots, see `refreshes.Refreshes.summaries`; `expected`: sentences {buffer, outcomes,
        learned} about what is not there yet."""
        refreshes, path = self._of(request), self._service.path_of(request.match_info["run"])

        def answer() -> dict:
            found = refreshes.summaries()
            numbers = [entry["number"] for entry in found["snapshots"] if entry["kind"] == REFRESH]
            return found | {"expected": _expected(path, numbers)}

        return json_response(await asyncio.to_thread(answer))

    async def levels(self, request: web.Request) -> web.Response:
        """Levels of a snapshot: ?sort=score&order=down&filter=joints>=1&offset=0&limit=96, see `level_page`."""
        query, refreshes = request.query, self._of(request)
        kind, snapshot_number = request.match_info["kind"], int(request.match_info["number"])
        offset = int(number(query, "offset", 0, low=0))
        limit = int(number(query, "limit", LEVELS_PER_PAGE, low=1, high=MAX_LEVELS_PER_PAGE))

        def answer() -> dict:
            try:
                snapshot = refreshes.snapshot(kind, snapshot_number)
            except (KeyError, FileNotFoundError):
                raise UnknownRunError(f"there is no {kind} {snapshot_number} in this run (any more)") from None
            plays = refreshes.plays(snapshot_number) if kind == REFRESH else None
            return level_page(
                snapshot,
                plays,
                sort=query.get("sort", "slot"),
                descending=query.get("order", "up") == "down",
                filter_text=query.get("filter", ""),
                offset=offset,
                limit=limit,
            )

        return json_response(await asyncio.to_thread(answer))

    async def history(self, request: web.Request) -> web.Response:
        """History of a level, see `level_history`; with `problems`."""
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
        return self.refreshes_of(self._service.path_of(request.match_info["run"]))

    def refreshes_of(self, path: Path) -> Refreshes:
        """The one reader of snapshots of a run directory."""
        return self._refreshes.setdefault(path, Refreshes(path))


def _expected(path: Path, refreshes: list[int]) -> dict[str, str]:
    """Sentences about the first buffer and the first counts of a run, and what was learned from its newest buffer."""
    try:
        config = run_files.read_config(path)
    except run_files.RunFileError as error:
        return {"buffer": f"{error}.", "outcomes": f"{error}.", "learned": f"{error}."}
    last = run_files.last_row(path / run_files.METRICS, is_row=is_metrics_row).row or {}
    update = last.get("update")
    learned = next_probe(config, refreshes, is_over=status_of(path).is_over) if refreshes else ""
    return {"buffer": first_buffer(config, update), "outcomes": first_outcomes(config, update), "learned": learned}
