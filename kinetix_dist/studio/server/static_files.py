"""The files of the pages: HTML, ES modules, styles, as they are in the package; nothing is built.

They are read and compressed once, when the server starts, and answered with an ETag.
"""

from __future__ import annotations

import gzip
import hashlib
from pathlib import Path

from aiohttp import web

STATIC = Path(__file__).resolve().parents[1] / "static"
CONTENT_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".ico": "image/x-icon",
    ".png": "image/png",
    ".txt": "text/plain",
    ".ts": "text/plain",  # declarations of types, for the checker
}
COMPRESSED = {".html", ".js", ".css", ".json", ".svg"}


class StaticFiles:
    """All files below a directory, by their address below `static/`; `index.html` is also the address itself."""

    def __init__(self, directory: Path = STATIC) -> None:
        self._files: dict[str, tuple[bytes, bytes | None, str, str]] = {}
        for file in sorted(directory.rglob("*")):
            if file.is_file() and file.suffix in CONTENT_TYPES:
                content = file.read_bytes()
                small = gzip.compress(content, mtime=0) if file.suffix in COMPRESSED else None
                tag = hashlib.sha256(content).hexdigest()[:20]
                self._files[file.relative_to(directory).as_posix()] = (content, small, CONTENT_TYPES[file.suffix], tag)

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/", self.index),
            web.get("/favicon.ico", self.icon),
            web.get("/rerun/favicon.ico", self.icon),  # rerun's page asks for it beside itself
            web.get("/static/{name:.+}", self.file),
        ]

    async def index(self, request: web.Request) -> web.Response:
        return self._answer(request, "index.html")

    async def icon(self, request: web.Request) -> web.Response:
        """Where a browser looks for the icon of what links none, as a text or JSON. The picture of icon.svg."""
        return self._answer(request, "favicon.ico")

    async def file(self, request: web.Request) -> web.Response:
        return self._answer(request, request.match_info["name"])

    def _answer(self, request: web.Request, name: str) -> web.Response:
        if name not in self._files:
            raise web.HTTPNotFound(text=f"there is no file {name}\n")
        content, small, content_type, tag = self._files[name]
        headers = {"ETag": f'"{tag}"', "Vary": "Accept-Encoding"}
        if any(etag.value == tag for etag in request.if_none_match or ()):
            return web.Response(status=304, headers=headers)
        if small is not None and "gzip" in request.headers.get("Accept-Encoding", ""):
            content, headers = small, headers | {"Content-Encoding": "gzip"}
        return web.Response(body=content, content_type=content_type, charset="utf-8", headers=headers)
