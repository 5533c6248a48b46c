"""Directory of the results of one design: design.json with its hash, arms/RUN (run directories), logs/RUN.log.

It is locked while a command works in it, and belongs to one design: results of another are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.json_text import json_text
from kinetix_dist.runtime import RunDirectoryError, lock_directory
from kinetix_dist.studio.runs.run_files import CONFIG, read_object
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.objective import seconds_so_far

DESIGN, ARMS, LOGS = "design.json", "arms", "logs"


def directory_of(path: Path, run: Run) -> Path:
    """Directory of a run of the design in `path`."""
    return path / ARMS / run.name


def done_so_far(path: Path, runs: Sequence[Run]) -> dict[str, float]:
    """Seconds of training that each run has, by its name."""
    return {run.name: seconds_so_far(directory_of(path, run)) for run in runs}


def check_design(path: Path, design_hash: str) -> bool:
    """True where results of this design are in `path`. Raises UserError for those of another."""
    with user_errors(ValueError, OSError, prefix=f"{path}: "):
        known = read_object(path / DESIGN)
    if known is not None and known.get("hash") != design_hash:
        raise UserError(
            f"{path} holds results of another design (hash {known.get('hash')}, this one has {design_hash}); "
            "name another directory with --out"
        )
    return known is not None


class ResultsDirectory:
    """The directory, taken until `close`."""

    def __init__(self, path: Path, design_hash: str, design: Any) -> None:
        """Takes the directory and writes the design, plain values, where there is none. Raises UserError for a
        directory of another design, or in use."""
        self.path = path
        with user_errors(OSError, RunDirectoryError):
            if (path / CONFIG).exists():
                raise UserError(f"{path} holds a run of `kinetix-dist train`; name another directory with --out")
            for folder in (path, path / ARMS, path / LOGS):
                folder.mkdir(parents=True, exist_ok=True)
            self._lock = lock_directory(path, "--out")
        try:
            if not check_design(path, design_hash):
                write_json(path / DESIGN, {"hash": design_hash, "design": design})
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._lock.close()


def write_json(file: Path, content: Any) -> None:
    """Raises UserError where the file cannot be written."""
    with user_errors(OSError, prefix=f"{file} cannot be written: "):
        replace_file(file, (json_text(content, indent=1) + "\n").encode())
