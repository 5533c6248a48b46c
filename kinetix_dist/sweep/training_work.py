"""Training runs as work of `run_loop.py`: `kinetix-dist train` into arms/RUN/, resumed where that was begun."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from kinetix_dist.studio.runs.run_files import CONFIG, read_object
from kinetix_dist.sweep.arms import Run, train_arguments
from kinetix_dist.sweep.results_directory import LOGS, directory_of

STOP_GRACE_S = 30.0  # beyond run.stop_seconds, at which a run ends itself wherever it is


def seconds_to_stop(runs: Sequence[Run]) -> float:
    """Seconds after which all runs that were stopped have ended."""
    return max(run.config.run.stop_seconds for run in runs) + STOP_GRACE_S


@dataclasses.dataclass(frozen=True)
class TrainingWork:
    """Training runs of one recipe in the directory of results `path`."""

    path: Path
    recipe: str

    def command(self, run: Run) -> tuple[list[str], bool]:
        directory = directory_of(self.path, run)
        goes_on = (directory / CONFIG).is_file()
        arguments = ["--resume"] if goes_on else train_arguments(run, self.recipe, self.path / LOGS)
        return ["train", "--run", str(directory), *arguments], goes_on

    def seconds_to_stop(self, run: Run) -> float:
        return seconds_to_stop([run])

    def ended(self, run: Run, status: int) -> str:
        del status
        stored = read_object(directory_of(self.path, run) / CONFIG) or {}
        is_own = not stored or stored.get("hash") == run.config.hash
        return "" if is_own else f"it was trained with another configuration ({stored['hash']}, not {run.config.hash})"
