"""`kinetix-dist dashboard [RUN|DIR ...]`: pages over run directories, while they are written and afterwards.

    kinetix-dist dashboard                              the runs below runs/
    kinetix-dist dashboard runs/quickstart runs/other   these two
    kinetix-dist dashboard --port 9000 --open           in a browser, at another port

Nothing is written to a run, and nothing is fetched from a network. The printed address carries a token, which opens
the runs.
"""

from __future__ import annotations

import dataclasses
import getpass
import os
import socket
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import tyro

from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError
from kinetix_dist.studio.server.access import is_loopback
from kinetix_dist.studio.server.app import DEFAULT_PORT, ServerConfig, serve


@dataclasses.dataclass
class ServerArgs:
    """Address at which pages are served, and who may read them."""

    port: int = DEFAULT_PORT
    """Port to listen on; the next free one if it is busy, any if 0."""
    host: str = "127.0.0.1"
    """The address to listen on; others than 127.0.0.1 can be reached from other machines, without encryption."""
    allow_host: tuple[str, ...] = ()
    """Further names under which the server is reached, behind a proxy say."""
    open: bool = False
    """Open the address in a browser."""
    play: bool = True
    """Start a process that plays levels and draws them when it is needed; without it pages that need it say so."""


def serve_pages(name: str, args: ServerArgs, pages: ServerConfig) -> int:
    """Serves pages until Ctrl-C at the address of `args`. name: what the address is called."""
    if not 0 <= args.port <= 65535:
        raise UserError(f"--port is {args.port}; it must be 0 to 65535")
    server = dataclasses.replace(
        pages, port=args.port, host=args.host, allowed_hosts=args.allow_host, has_play=args.play
    )

    def listening(token: str, port: int) -> None:
        address = f"http://{_in_address(args.host)}:{port}/?token={token}"
        print(f"{name:<10} {address}")
        if args.port not in (0, port):
            print(f"           port {args.port} is busy")
        if not is_loopback(args.host):
            print("           reachable from other machines; traffic is not encrypted")
        elif not _has_display():
            print(f"from afar  ssh -L {port}:127.0.0.1:{port} {getpass.getuser()}@{socket.gethostname()}")
        print("           Ctrl-C ends it", flush=True)
        if args.open and not webbrowser.open(address):
            say("kinetix-dist: no browser could be opened; open the address above in one", sys.stderr)

    serve(server, listening)
    return 0


def _in_address(host: str) -> str:
    """Name of this machine under which an address that is listened on is reached."""
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def _has_display() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


RUNS = Path("runs")


@dataclasses.dataclass
class Args(ServerArgs):
    """Serve pages over runs: curves, curriculum, levels, rollouts, comparison."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Run directories, and directories of runs (two levels deep); default: runs/."""


def run(args: Args) -> int:
    if not args.paths and not RUNS.is_dir():
        raise UserError(f"there is no directory {RUNS}/ here; name a run directory, or a directory of runs")
    return serve_pages("dashboard", args, ServerConfig(paths=args.paths or (RUNS,)))
