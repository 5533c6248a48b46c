"""Verdicts in a process of its own, for the table of runs: a path a line in, the summary of its verdict a line out.

    server --"path"--> python -m kinetix_dist.studio.runs.verdict_process --{outcome, rank, state, heading}--> server

The server stays responsive while dozens of runs are read, and what they took is free when the process ends, with its
input. A verdict that fails is a bug: it ends the process, with a traceback.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

from kinetix_dist.json_text import json_text
from kinetix_dist.studio.runs.processes import Processes
from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.studio.runs.verdict import verdict_of


def summary_of(path: Path) -> dict[str, Any]:
    """Summary of the verdict on a run, whose files are read for it alone."""
    reader = RunReader(path)
    reader.read_first(lambda bytes_left: None)
    return verdict_of(reader, Refreshes(path), Processes(path)).summary()


def main(lines: Iterable[str], out: IO[str]) -> None:
    """Main function of the process."""
    for line in lines:
        out.write(json_text(summary_of(Path(json.loads(line)))) + "\n")
        out.flush()


if __name__ == "__main__":
    main(sys.stdin, sys.stdout)
