"""The server: one process, one event loop, no jax.

    browser --HTTP, one websocket--> app --(threads)--> run directories, read only
                                      |--(pipe)--> engine worker: draws, plays and decodes levels
                                      |--> `kinetix-dist finetune` or `levels solve`, one at a time (teaching.py)

Every response is made from files when it is requested. Only runs that were read are cached.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import errno
import logging
import signal
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from kinetix_dist.errors import UserError, one_line
from kinetix_dist.evaluation.intervals import t_95
from kinetix_dist.studio.runs.run_files import RunFileError
from kinetix_dist.studio.runs.series import AxisError
from kinetix_dist.studio.runs.snapshot_levels import LevelQueryError
from kinetix_dist.studio.server.access import Access
from kinetix_dist.studio.server.channel import Channel
from kinetix_dist.studio.server.compare_pages import ComparePages
from kinetix_dist.studio.server.editor_pages import EditorConfig, EditorPages
from kinetix_dist.studio.server.evaluation_pages import EvaluationPages
from kinetix_dist.studio.server.level_pages import CurriculumPages, LevelPages, worker_error_response
from kinetix_dist.studio.server.malformed import quiet_malformed, refuse_malformed
from kinetix_dist.studio.server.rerun_viewer import OPEN_PATH, RerunViewer
from kinetix_dist.studio.server.responses import BadRequestError, StaticFiles, error_response
from kinetix_dist.studio.server.run_pages import RunPages
from kinetix_dist.studio.server.run_service import RunService, UnknownRunError
from kinetix_dist.studio.server.teaching import Teaching
from kinetix_dist.studio.server.teaching_pages import TeachingPages
from kinetix_dist.studio.server.verdict_pages import VerdictPages
from kinetix_dist.studio.server.verdict_summaries import VerdictSummaries
from kinetix_dist.studio.server.worker_client import WorkerClient, WorkerError
from kinetix_dist.telemetry.curriculum_log import SnapshotError

LOG = logging.getLogger(__name__)
DEFAULT_PORT = 8650
MAX_BODY_BYTES = 8 << 20


@dataclasses.dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Runs that are served, where, and to whom."""

    paths: tuple[Path, ...] = (Path("runs"),)  # runs, and directories of runs
    optional_paths: tuple[Path, ...] = ()  # directories whose runs are served if they exist and hold any
    port: int = DEFAULT_PORT
    host: str = "127.0.0.1"
    allowed_hosts: tuple[str, ...] = ()  # further names in Host and Origin, such as a proxy's
    has_play: bool = True  # whether the engine worker may be started
    editor: EditorConfig = dataclasses.field(default_factory=EditorConfig)
    first_page: str = ""  # the part of the address behind # that the printed address leads to


def make_app(config: ServerConfig, access: Access) -> web.Application:
    """Application with all pages. Raises UserError for paths that hold no runs."""
    service = RunService(config.paths)
    for path in (*config.optional_paths, config.editor.results):
        if path.is_dir():
            service.add(path)
    worker = WorkerClient(is_allowed=config.has_play)
    verdicts = VerdictSummaries()
    teaching = Teaching(config.editor.results, worker, service)
    channels: set[Channel] = set()

    async def open_channel(request: web.Request) -> web.StreamResponse:
        channel = Channel(service, worker, has_play=config.has_play)
        channels.add(channel)
        try:
            return await channel.serve(request)
        finally:
            channels.discard(channel)

    async def close_channels(app: web.Application) -> None:
        for channel in list(channels):
            await channel.close()

    async def end_processes(app: web.Application) -> None:
        await teaching.cancel()
        await verdicts.close()
        await worker.close()

    middlewares = [refuse_malformed, access.middleware, one_line_errors, _find_new_runs(service)]
    app = web.Application(middlewares=middlewares, client_max_size=MAX_BODY_BYTES)
    app.on_response_prepare.append(access.add_headers)
    rerun = RerunViewer(service, worker)
    curricula, evaluated = CurriculumPages(service), EvaluationPages(service, worker)
    for pages in (
        RunPages(service, verdicts),
        ComparePages(service),
        curricula,
        VerdictPages(service, curricula, evaluated),
        LevelPages(service, worker),
        evaluated,
        EditorPages(config.editor, worker),
        TeachingPages(teaching),
        StaticFiles(),
        rerun,
    ):
        app.add_routes(pages.routes())
    app.add_routes([web.get("/channel", open_channel)])
    app.cleanup_ctx.extend((_following(service), rerun.lifetime, _loading))
    app.on_shutdown.append(close_channels)
    app.on_cleanup.append(end_processes)
    return app


@web.middleware
async def one_line_errors(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Middleware: turns what is wrong with a request or a file into one line.

    Anything else is a bug: the console gets its traceback, and the page a line.
    """
    try:
        return await handler(request)
    except UnknownRunError as error:
        return error_response(404, one_line(error.args[0]))
    except (BadRequestError, AxisError, LevelQueryError, UserError) as error:
        return error_response(400, str(error))
    except WorkerError as error:
        return worker_error_response(error)
    except (RunFileError, SnapshotError) as error:
        return error_response(422, str(error))
    except web.HTTPException:
        raise
    except Exception as error:
        LOG.exception("a request was not answered: %s", one_line(request.path))
        return error_response(
            500, f"a bug in the server ({type(error).__name__}: {one_line(error)}); its console has the traceback"
        )


def _find_new_runs(service: RunService) -> Middleware:
    @web.middleware
    async def look(request: web.Request, handler: Handler) -> web.StreamResponse:
        if "run" in request.match_info:
            await service.look_for(request.match_info["run"])
        return await handler(request)

    return look


def _following(service: RunService) -> Callable[[web.Application], AsyncIterator[None]]:
    async def follow(app: web.Application) -> AsyncIterator[None]:
        task = asyncio.create_task(service.follow())
        yield
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    return follow


async def _loading(app: web.Application) -> AsyncIterator[None]:
    """Imports scipy, which quantiles of intervals need, before a page waits for it: a second on a busy core."""
    task = asyncio.create_task(asyncio.to_thread(t_95, 1))
    yield
    await task


MAX_PORTS = 50  # that are tried, from the requested one on
SHUTDOWN_SECONDS = 2.0  # for pages that do not close their connection


def serve(config: ServerConfig, listening: Callable[[str, int], None]) -> None:
    """Runs the server until SIGINT or SIGTERM. `listening(token, port)` is called once requests are answered.

    Raises UserError: no port is free, a host that is not this machine's, paths that hold no runs.
    """
    sockets = _listen(config.host, config.port)
    port = sockets.getsockname()[1]
    with sockets:
        access = Access(
            port=port,
            host=config.host,
            allowed_hosts=config.allowed_hosts,
            open_paths=[OPEN_PATH],
            first_page=config.first_page,
        )
        app = make_app(config, access)
        asyncio.run(_serve(app, sockets, lambda: listening(access.token, port)))


async def _serve(app: web.Application, listener: socket.socket, listening: Callable[[], None]) -> None:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    logging.getLogger("aiohttp.server").addFilter(quiet_malformed)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=SHUTDOWN_SECONDS)  # a log would hold the token
    await runner.setup()
    try:
        await web.SockSite(runner, listener).start()
        listening()
        await ended.wait()
    finally:
        await runner.cleanup()


def _listen(host: str, first_port: int) -> socket.socket:
    """Socket that listens at the first free port from `first_port` on; 0: any. Raises UserError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    last_port = min(first_port + MAX_PORTS - 1, 65535) if first_port else 0
    for port in range(first_port, last_port + 1):
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
            listener.listen()
            return listener
        except OSError as error:
            listener.close()
            if error.errno == errno.EADDRINUSE:
                continue
            if error.errno == errno.EACCES:
                raise UserError(f"--port {port} may not be listened on; choose one from 1024 on") from error
            reason = error.strerror or str(error)
            raise UserError(f"--host {host} cannot be listened on ({reason}); leave it out for 127.0.0.1") from error
    raise UserError(f"ports {first_port} to {last_port} are all busy; choose another with --port")
