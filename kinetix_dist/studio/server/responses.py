"""Responses of the server: JSON, one-line errors, static files; and numbers of queries."""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aiohttp import web

from kinetix_dist.errors import one_line

COMPRESS_FROM_BYTES = 1024


class BadRequestError(ValueError):
    """A request that makes no sense, with the reason in one line."""


def json_response(content: Any, *, status: int = 200) -> web.Response:
    """JSON response, compressed from COMPRESS_FROM_BYTES on. Raises ValueError for nan, a bug of ours."""
    body = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
    response = web.Response(body=body, status=status, content_type="application/json", charset="utf-8")
    if len(body) >= COMPRESS_FROM_BYTES:
        response.enable_compression()
    return response


def error_response(status: int, text: str) -> web.Response:
    """Return the JSON response {"error": one line}."""
    return json_response({"error": one_line(text)}, status=status)


def number(
    query: Mapping[str, str],
    name: str,
    default: float | None = None,
    *,
    low: float = -math.inf,
    high: float = math.inf,
) -> Any:
    """Number of a query. Raises BadRequestError for anything else, and outside of its range."""
    text = query.get(name, "")
    if text == "":
        return default
    try:
        value = float(text)
    except ValueError:
        raise BadRequestError(f"{name} is {text!r}; it must be a number") from None
    if not math.isfinite(value) or not low <= value <= high:
        raise BadRequestError(f"{name} is {text}; it must be between {low:g} and {high:g}")
    return value


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
FOR_GOOD = "private, max-age=31536000, immutable"
COMPRESSED = {".html", ".js", ".css", ".json", ".svg"}


class StaticFiles:
    """Files of the pages (HTML, ES modules, styles) as they are in the package; nothing is built.

    All are read and compressed once, when the server starts, and answered with an ETag. The page names scripts and
    styles below a path with the hash of all files, `static/HASH/app.js`, where they stay what they are: a browser
    requests these 90 files once per version instead of with every page. Modules import each other by relative paths,
    so that they come from there, too.
    """

    def __init__(self, directory: Path = STATIC) -> None:
        self._files: dict[str, tuple[bytes, bytes | None, str, str]] = {}
        for file in sorted(directory.rglob("*")):
            if file.is_file() and file.suffix in CONTENT_TYPES:
                content = file.read_bytes()
                small = gzip.compress(content, mtime=0) if file.suffix in COMPRESSED else None
                tag = hashlib.sha256(content).hexdigest()[:20]
                self._files[file.relative_to(directory).as_posix()] = (content, small, CONTENT_TYPES[file.suffix], tag)
        tags = "".join(f"{name} {tag}\n" for name, (*_, tag) in self._files.items())
        self._version = hashlib.sha256(tags.encode()).hexdigest()[:20]
        self._add_index(directory / "index.html")

    def _add_index(self, file: Path) -> None:
        """Adds the page with the version in the paths of its scripts and styles."""
        named = re.compile(r'((?:src|href)="static/)(?=[^"]+\.(?:js|css)")')
        content = named.sub(rf"\g<1>{self._version}/", file.read_text()).encode()
        tag = hashlib.sha256(content).hexdigest()[:20]
        self._files[file.name] = (content, gzip.compress(content, mtime=0), CONTENT_TYPES[file.suffix], tag)

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/", self.index),
            web.get("/favicon.ico", self.icon),
            web.get("/rerun/favicon.ico", self.icon),  # rerun's page requests it next to itself
            web.get(f"/static/{self._version}/{{name:.+}}", self.versioned),
            web.get("/static/{name:.+}", self.file),
        ]

    async def index(self, request: web.Request) -> web.Response:
        return self._answer(request, "index.html")

    async def icon(self, request: web.Request) -> web.Response:
        """Icon of texts and JSON, which link none: the picture of icon.svg."""
        return self._answer(request, "favicon.ico")

    async def file(self, request: web.Request) -> web.Response:
        return self._answer(request, request.match_info["name"])

    async def versioned(self, request: web.Request) -> web.Response:
        response = self._answer(request, request.match_info["name"])
        response.headers["Cache-Control"] = FOR_GOOD
        return response

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
