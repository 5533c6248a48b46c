"""HTTP API of the editor: level sets, and the level files named on the command line.

Checks, play and changes by the engine worker go over the channel (play_channel.py).

    GET api/engine                sizes, walls, palette, mutators, generators, pretrained policies
    GET api/levels                {sets: [{name, description, size, count}], files: {...} or null, opens, plays}
    GET api/levels/sets/NAME      {levels: [{name, text}]}
    GET api/files                 {files: [{name, text, hash} or {name, problem}]}
    GET, PUT api/files/NAME       {name, text, hash}; PUT has the text, and `If-Match: "HASH"` or `If-None-Match: *`
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import web

from kinetix_dist.level.level_data import designed_sets, levels_root
from kinetix_dist.studio.server.level_files import ConflictError, FileNameError, LevelFiles
from kinetix_dist.studio.server.malformed import body_text, json_object
from kinetix_dist.studio.server.responses import BadRequestError, error_response, json_response
from kinetix_dist.studio.server.worker_client import WorkerClient
from kinetix_dist.text_files import read_text

MAX_GALLERY = 500  # files whose texts are sent at once


@dataclasses.dataclass(frozen=True, kw_only=True)
class EditorConfig:
    """Arguments of `kinetix-dist edit` or `levels play`."""

    files: LevelFiles | None = None  # None: nothing can be saved here, levels are downloaded
    # The level that is shown first: "designed/s/hop_home", "file/mine.json", "link/1.eJx..."; None: the gallery.
    opens: str | None = None
    # Who plays it at once: "keys", "random", "noop" or "checkpoint:generalist"; None: it is shown for editing.
    plays: str | None = None
    results: Path = Path("runs/taught")  # directory for what `teach it` and `solve it` make


class EditorPages:
    """Handlers of `api/engine`, `api/levels` and `api/files`."""

    def __init__(self, config: EditorConfig, worker: WorkerClient) -> None:
        self._config = config
        self._worker = worker

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/api/engine", self.engine),
            web.get("/api/levels", self.levels),
            web.get("/api/levels/sets/{name}", self.level_set),
            web.get("/api/files", self.files),
            web.get("/api/files/{name:.+}", self.file),
            web.put("/api/files/{name:.+}", self.save),
        ]

    async def engine(self, request: web.Request) -> web.Response:
        hello = await self._worker.hello()
        return json_response({name: value for name, value in hello.items() if name not in ("type", "version", "pid")})

    async def levels(self, request: web.Request) -> web.Response:
        sets = [
            {"name": name, "description": entry["description"], "size": entry["size"], "count": len(entry["levels"])}
            for name, entry in designed_sets().items()
        ]
        files = self._config.files
        about = None if files is None else {"directory": str(files.directory.resolve()), "only": files.only}
        return json_response({"sets": sets, "files": about, "opens": self._config.opens, "plays": self._config.plays})

    async def level_set(self, request: web.Request) -> web.Response:
        sets, name = designed_sets(), request.match_info["name"]
        if name not in sets:
            return error_response(404, f"there is no set {name!r}; sets are {', '.join(sets)}")
        root = levels_root()
        return json_response(
            {
                "levels": [
                    {"name": file.removesuffix(".json"), "text": read_text(root / file)}
                    for file in sets[name]["levels"]
                ]
            }
        )

    async def files(self, request: web.Request) -> web.Response:
        """Names of all level files, and texts of the first MAX_GALLERY."""
        files = self._named_files()
        names = await asyncio.to_thread(files.names)
        return json_response({"files": await asyncio.to_thread(_gallery, files, names), "count": len(names)})

    async def file(self, request: web.Request) -> web.Response:
        files, name = self._named_files(), request.match_info["name"]
        return await _answer(lambda: dataclasses.asdict(files.read(name)))

    async def save(self, request: web.Request) -> web.Response:
        files, name = self._named_files(), request.match_info["name"]
        text = await body_text(request)
        try:
            json_object(text, f"{name}:")
        except BadRequestError as error:
            raise BadRequestError(f"{error}; nothing was saved") from error
        was = _expected(request)
        return await _answer(lambda: {"hash": files.save(name, text, was=was)})

    def _named_files(self) -> LevelFiles:
        if self._config.files is None:
            raise BadRequestError("no file or directory was named: start `kinetix-dist edit FILE` or `... DIR` to save")
        return self._config.files


def _expected(request: web.Request) -> str | None:
    """Hash that the file must have; None: it must be new."""
    match, none_match = request.headers.get("If-Match"), request.headers.get("If-None-Match")
    if none_match == "*" and match is None:
        return None
    if match is None or none_match is not None:
        raise BadRequestError('give `If-Match: "HASH"` for a file that was read, `If-None-Match: *` for a new one')
    return match.strip('"')


async def _answer(act: Callable[[], dict[str, Any]]) -> web.Response:
    try:
        return json_response(await asyncio.to_thread(act))
    except FileNameError as error:
        return error_response(400, str(error))
    except ConflictError as error:
        return json_response({"error": str(error), "hash": error.hash}, status=412)
    except FileNotFoundError as error:
        return error_response(404, f"there is no file {error.filename} (any more)")
    except PermissionError as error:
        return error_response(403, f"{error.filename}: {error.strerror}; nothing was changed")
    except OSError as error:
        return error_response(507, f"{error.filename}: {error.strerror}; nothing was changed")


def _gallery(files: LevelFiles, names: list[str]) -> list[dict[str, Any]]:
    listed: list[dict[str, Any]] = []
    for name in names[:MAX_GALLERY]:
        try:
            listed.append(dataclasses.asdict(files.read(name)))
        except (OSError, FileNameError) as error:
            listed.append({"name": name, "problem": str(error)})
    return listed + [{"name": name} for name in names[MAX_GALLERY:]]
