"""`kinetix-dist dashboard [RUN|DIR ...]`: pages over run directories, while they are written and afterwards.

    kinetix-dist dashboard                              the runs below runs/
    kinetix-dist dashboard runs/quickstart runs/other   these two
    kinetix-dist dashboard --port 9000 --open           in a browser, at another port

Nothing is written to a run, and nothing is fetched from a network. The printed address carries a token, which opens
the runs.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from kinetix_dist.cli.page_server import ServerArgs, serve_pages
from kinetix_dist.errors import UserError
from kinetix_dist.studio.server.app import ServerConfig

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
