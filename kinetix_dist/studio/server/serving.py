"""Runs the server until a signal ends it: finds a port, prints nothing itself, tells the address when it listens."""

from __future__ import annotations

import asyncio
import errno
import signal
import socket
from collections.abc import Callable

from aiohttp import web

from kinetix_dist.errors import UserError
from kinetix_dist.studio.server.access import Access
from kinetix_dist.studio.server.app import ServerConfig, make_app
from kinetix_dist.studio.server.rerun_viewer import OPEN_PATH

MAX_PORTS = 50  # that are tried, from the one asked for on
SHUTDOWN_SECONDS = 2.0  # for pages that do not close their connection


def serve(config: ServerConfig, listening: Callable[[str, int], None]) -> None:
    """Until SIGINT or SIGTERM. `listening(token, port)` is called once requests are answered.

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
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=SHUTDOWN_SECONDS)  # a log would hold the token
    await runner.setup()
    try:
        await web.SockSite(runner, listener).start()
        listening()
        await ended.wait()
    finally:
        await runner.cleanup()


def _listen(host: str, first_port: int) -> socket.socket:
    """A socket that listens at the first free port from `first_port` on; 0: any. Raises UserError."""
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
