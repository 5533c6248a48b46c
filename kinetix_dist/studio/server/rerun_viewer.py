"""rerun in the page: its own web files, of the installed version, and rollouts as .rrd.

rerun hands out its files only while it serves them: it is started once on loopback, three files are fetched, and it is
ended. The files are cached in the user's cache by version. The engine worker makes an .rrd when it is requested, in a
directory that is removed with the server.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import hashlib
import os
import re
import socket
import tempfile
from collections.abc import AsyncIterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import aiohttp
from aiohttp import web

from kinetix_dist.child_python import command_of
from kinetix_dist.studio.server.access import UrlSigner
from kinetix_dist.studio.server.level_pages import recording_path
from kinetix_dist.studio.server.responses import error_response, json_response
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.worker_client import WorkerClient
from kinetix_dist.user_directories import cache_directory

FILES = {"index.html": "text/html", "re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
FOREIGN_LINKS = re.compile(rb'<link\b[^>]*href="https?://[^>]*>\s*')  # of its page: web fonts, which it does without
START_SECONDS = 30.0
OPEN_PATH = "/rrd/"  # its URLs are signed instead
# Its page has scripts and styles inline, and runs WebAssembly; it may connect to this server only.
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; font-src 'self' data:; worker-src 'self' blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


class RerunError(Exception):
    """rerun is not installed, or does not hand out its files: one line."""


class RerunViewer:
    """Handlers of `rerun/...` and `rrd/...`."""

    def __init__(self, service: RunService, worker: WorkerClient, *, cache: Path | None = None) -> None:
        """cache: where rerun's files are cached; None: in the user's cache directory."""
        self._service = service
        self._worker = worker
        self._cache = cache
        self._signer = UrlSigner()
        self._fetching = asyncio.Lock()
        self._making = asyncio.Lock()  # so that none is made twice
        self._rrds: dict[str, Path] = {}
        self._directory = Path()  # of .rrd files, once the server runs

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/rerun/{name}", self.file),
            web.get(OPEN_PATH + "{signature}/{name}", self.rrd),
            web.get("/api/runs/{run}/recordings/{file}/{index:[0-9]{1,8}}/rrd", self.make),
        ]

    async def lifetime(self, app: web.Application) -> AsyncIterator[None]:
        """Context of the application (`cleanup_ctx`): the directory of .rrd files."""
        with tempfile.TemporaryDirectory(prefix="kinetix_dist_rrd_") as directory:
            self._directory = Path(directory)
            yield

    async def make(self, request: web.Request) -> web.Response:
        """Addresses {viewer, rrd} of the viewer and of a rollout's .rrd, whose full URL the viewer takes as `url`."""
        info = request.match_info
        path = recording_path(self._service.path_of(info["run"]), info["file"])
        try:
            name, _ = await asyncio.gather(self._rrd_of(path, int(info["index"])), self._files())
        except RerunError as error:
            return error_response(502, str(error))
        rrd = f"rrd/{self._signer.sign(name)}/{name}"
        return json_response({"viewer": "rerun/index.html", "rrd": rrd})

    async def file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in FILES:
            raise web.HTTPNotFound(text=f"there is no file {name}\n")
        try:
            folder = await self._files()
        except RerunError as error:
            return error_response(502, str(error))
        headers = {"Content-Type": FILES[name], "Content-Security-Policy": POLICY, "Vary": "Accept-Encoding"}
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            return web.FileResponse(folder / f"{name}.gz_", headers=headers | {"Content-Encoding": "gzip"})
        return web.FileResponse(folder / name, headers=headers)

    async def rrd(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if not self._signer.is_valid(request.match_info["signature"], name) or name not in self._rrds:
            return error_response(403, "the address of this rollout has expired; open it from its page again")
        return web.FileResponse(self._rrds[name], headers={"Content-Type": "application/octet-stream"})

    async def _rrd_of(self, recording: Path, index: int) -> str:
        """Name of the .rrd of a rollout, made if it does not exist."""
        status = recording.stat()
        key = f"{recording} {status.st_mtime_ns} {status.st_size} {index}"
        name = f"{recording.stem}_{index:03d}_{hashlib.sha256(key.encode()).hexdigest()[:12]}.rrd"
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
        async with self._making:
            if name not in self._rrds:
                target = self._directory / name
                await self._worker.request("rrd", {"file": str(recording), "index": index, "to": str(target)})
                self._rrds[name] = target
        return name

    async def _files(self) -> Path:
        """Directory of rerun's files, fetched once per installed version."""
        try:
            installed = version("rerun-sdk")
        except PackageNotFoundError:
            raise RerunError("rerun is not installed; install rerun-sdk, or use the player of this page") from None
        folder = (self._cache or cache_directory()) / f"rerun-web-{installed}"
        async with self._fetching:
            if not all((folder / f"{name}.gz_").is_file() for name in FILES):
                try:
                    await _fetch(folder)
                except (OSError, aiohttp.ClientError, TimeoutError) as error:
                    reason = " ".join(str(error).split()) or type(error).__name__
                    raise RerunError(f"rerun {installed} does not hand out its web files ({reason})") from error
        return folder


async def _fetch(folder: Path) -> None:
    """Fetches rerun's web files from rerun itself, which is ended afterwards."""
    port, data_port = _free_port(), _free_port()
    process = await asyncio.create_subprocess_exec(
        *command_of("rerun", "--serve-web", "--bind", "127.0.0.1", "--port", data_port, "--web-viewer-port", port),
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    try:
        async with asyncio.timeout(START_SECONDS), aiohttp.ClientSession() as session:
            for name in FILES:
                content = await _get(session, f"http://127.0.0.1:{port}/{name}", process)
                await asyncio.to_thread(
                    _store, folder, name, FOREIGN_LINKS.sub(b"", content) if name.endswith(".html") else content
                )
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, 9)
        await process.wait()


async def _get(session: aiohttp.ClientSession, address: str, process: asyncio.subprocess.Process) -> bytes:
    while True:
        try:
            async with session.get(address) as answer:
                answer.raise_for_status()
                return await answer.read()
        except aiohttp.ClientConnectionError:
            if process.returncode is not None:
                raise
            await asyncio.sleep(0.1)


def _store(folder: Path, name: str, content: bytes) -> None:
    """Stores a file and its gzip next to it, each by a rename. The gzip comes last: where it exists, both do."""
    folder.mkdir(parents=True, exist_ok=True)
    for suffix, data in (("", content), (".gz_", gzip.compress(content, 6))):
        draft = folder / f".{name}{suffix}.{os.getpid()}"
        draft.write_bytes(data)
        draft.replace(folder / f"{name}{suffix}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
