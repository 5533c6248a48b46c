"""The server: one process, one event loop, no jax.

    browser --HTTP, one websocket--> app --(threads)--> run directories, read only
                                      |--(pipe)--> engine worker: draws, plays and decodes levels

Every answer is made from files when it is asked for; nothing is kept but what runs were read so far.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

from aiohttp import web

from kinetix_dist.errors import UserError, one_line
from kinetix_dist.studio.runs.levels import LevelQueryError
from kinetix_dist.studio.runs.run_files import RunFileError
from kinetix_dist.studio.runs.series import AxisError
from kinetix_dist.studio.server.access import Access, Handler
from kinetix_dist.studio.server.answers import BadRequestError, error_response
from kinetix_dist.studio.server.channel import Channel
from kinetix_dist.studio.server.compare_pages import ComparePages
from kinetix_dist.studio.server.curriculum_pages import CurriculumPages
from kinetix_dist.studio.server.editor_pages import EditorConfig, EditorPages
from kinetix_dist.studio.server.level_pages import LevelPages, worker_error_response
from kinetix_dist.studio.server.rerun_viewer import RerunViewer
from kinetix_dist.studio.server.run_pages import RunPages
from kinetix_dist.studio.server.run_service import RunService, UnknownRunError
from kinetix_dist.studio.server.static_files import StaticFiles
from kinetix_dist.studio.server.worker_client import WorkerClient, WorkerError
from kinetix_dist.telemetry.curriculum_log import SnapshotError

LOG = logging.getLogger(__name__)
DEFAULT_PORT = 8650
MAX_BODY_BYTES = 8 << 20


@dataclasses.dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """What is served, where, to whom."""

    paths: tuple[Path, ...] = (Path("runs"),)  # runs, and directories of runs
    port: int = DEFAULT_PORT
    host: str = "127.0.0.1"
    allowed_hosts: tuple[str, ...] = ()  # further names in Host and Origin, of a proxy say
    has_play: bool = True  # whether the engine worker may be started
    editor: EditorConfig = dataclasses.field(default_factory=EditorConfig)
    first_page: str = ""  # the part of the address behind # that the printed address leads to


def make_app(config: ServerConfig, access: Access) -> web.Application:
    """Raises UserError for paths that hold no runs."""
    service = RunService(config.paths)
    worker = WorkerClient(is_allowed=config.has_play)
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

    async def end_worker(app: web.Application) -> None:
        await worker.close()

    middlewares = [access.middleware, _errors_are_lines, _new_runs_are_found(service)]
    app = web.Application(middlewares=middlewares, client_max_size=MAX_BODY_BYTES)
    app.on_response_prepare.append(access.add_headers)
    rerun = RerunViewer(service, worker)
    for pages in (
        RunPages(service),
        ComparePages(service),
        CurriculumPages(service),
        LevelPages(service, worker),
        EditorPages(config.editor, worker),
        StaticFiles(),
        rerun,
    ):
        app.add_routes(pages.routes())
    app.add_routes([web.get("/channel", open_channel)])
    app.cleanup_ctx.extend((_following(service), rerun.lifetime))
    app.on_shutdown.append(close_channels)
    app.on_cleanup.append(end_worker)
    return app


@web.middleware
async def _errors_are_lines(request: web.Request, handler: Handler) -> web.StreamResponse:
    """What was wrong with a request or a file, as one line. Anything else is a bug: the console gets its traceback, and
    the page a line that says so."""
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
        LOG.exception("a request was not answered: %s", request.path)
        return error_response(500, f"a mistake of the server ({type(error).__name__}: {error}); its console says more")


def _new_runs_are_found(service: RunService) -> Callable[[web.Request, Handler], Awaitable[web.StreamResponse]]:
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
