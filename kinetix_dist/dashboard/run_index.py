"""Which runs there are below the paths that a person named, and how each of them is.

A path is a run or a directory of runs (two levels deep). Runs that appear later are found; one that is gone is left
out. The name of a run in addresses is that of its directory, made unique where two have the same.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.dashboard import run_files
from kinetix_dist.dashboard.evaluations import newest_rates
from kinetix_dist.dashboard.run_files import RunFileError, last_row, read_object
from kinetix_dist.errors import UserError, one_line
from kinetix_dist.telemetry.status import (
    FAILED,
    FINISHED,
    RUNNING,
    SILENT,
    SILENT_AFTER_S,
    STOPPED,
    StatusError,
    judged,
    read_status,
)
from kinetix_dist.telemetry.utc import utc_seconds

DEPTH = 2  # levels of directories below a path in which runs are looked for
MAX_RUNS = 5000

NO_RUN = "is no run (it has no config.json) and holds none; name a run directory, or a directory of runs"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunStatus:
    """How a run is, one line of why, and where that was read. What status.json does not say is None."""

    state: str  # "running", "silent", "finished", "stopped", "failed" or "not started"
    text: str
    source: str  # the file that says so; "files" where it follows from their times
    phase: str | None = None
    update: int | None = None
    env_steps: int | None = None
    seconds_left: float | None = None


class RunIndex:
    """Finds runs. `scan` looks again; ids stay with their directories."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Raises UserError for a path that is not there, is no directory, or holds neither run nor directory."""
        self._roots = [_checked(path) for path in paths]
        self._ids: dict[Path, str] = {}
        self.runs: dict[str, Path] = {}
        self.problems: list[str] = []
        self.scan()
        for root in self._roots:
            if not any(run.is_relative_to(root) for run in self.runs.values()) and not _may_come(root):
                raise UserError(f"{root} {NO_RUN}")

    def scan(self) -> dict[str, Path]:
        """Ids and directories of the runs that are there now."""
        self.problems = []
        found: dict[str, Path] = {}
        for root in self._roots:
            for path in self._runs_below(root, DEPTH):
                if len(found) >= MAX_RUNS:
                    self.problems.append(f"more than {MAX_RUNS} runs; name fewer directories")
                    break
                found[self._id_of(path)] = path
        self.runs = found
        return found

    def _runs_below(self, path: Path, depth: int) -> list[Path]:
        if run_files.is_run(path):
            return [path]
        if not depth:
            return []
        try:
            with os.scandir(path) as entries:
                below = sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))
        except OSError as error:
            self.problems.append(f"{path} cannot be read ({error.strerror})")
            return []
        return [run for name in below for run in self._runs_below(path / name, depth - 1)]

    def _id_of(self, path: Path) -> str:
        if path not in self._ids:
            name, number, taken = path.name, 1, set(self._ids.values())
            while name in taken:
                number += 1
                name = f"{path.name}~{number}"
            self._ids[path] = name
        return self._ids[path]


def summary(run_id: str, path: Path) -> dict[str, Any]:
    """One row of the table of runs: what its small files say. `problems` has a line for each that cannot be read."""
    problems: list[str] = []

    def read(name: str) -> dict[str, Any]:
        try:
            return read_object(path / name) or {}
        except RunFileError as error:
            problems.append(str(error))
            return {}

    config_file = read(run_files.CONFIG)
    config = config_file.get("config") if isinstance(config_file.get("config"), dict) else {}
    last = last_row(path / run_files.METRICS)
    status = status_of(path)
    evaluated: dict[str, Any] = {}
    try:
        evaluated = newest_rates(path)
    except RunFileError as error:
        problems.append(str(error))
    return {
        "id": run_id,
        "path": str(path),
        "name": _get(config, "run", "name"),
        "size": _get(config, "env", "size"),
        "curriculum": _get(config, "curriculum", "name"),
        "placement": _get(config, "run", "placement"),
        "hash": config_file.get("hash"),
        "total_env_steps": _get(config, "run", "total_env_steps"),
        "status": dataclasses.asdict(status),
        "modified": run_files.modified_at(path / run_files.METRICS) or run_files.modified_at(path / run_files.CONFIG),
        "last": last,
        "evaluated": evaluated,
        "problems": problems,
    }


def status_of(path: Path) -> RunStatus:
    """How a run is, by its status.json; by other files and their times where there is none (an older run)."""
    try:
        status = read_status(path / run_files.STATUS)
    except (StatusError, OSError) as error:
        return dataclasses.replace(_status_by_files(path), text=one_line(error))
    if status is None:
        return _status_by_files(path)
    state = judged(status)
    age = _age(time.time() - utc_seconds(status.time))
    text = {
        RUNNING: f"{status.phase}, written {age} ago by process {status.pid} on {status.host}",
        SILENT: f"says {status.phase}, but was last heard of {age} ago (process {status.pid} on {status.host})",
    }.get(state, status.error or f"ended {age} ago")
    return RunStatus(
        state=state,
        text=text,
        source=run_files.STATUS,
        phase=status.phase,
        update=status.update,
        env_steps=status.env_steps,
        seconds_left=status.seconds_left if state == RUNNING else None,
    )


def _status_by_files(path: Path) -> RunStatus:
    metrics = run_files.modified_at(path / run_files.METRICS)
    last_event = last_row(path / run_files.EVENTS) or {}
    if last_event.get("event") in ("run_failed", "stopped"):
        state = FAILED if last_event["event"] == "run_failed" else STOPPED
        return RunStatus(state=state, text=_text_of(last_event), source=run_files.EVENTS)
    if _is_reported(path):
        return RunStatus(state=FINISHED, text="report.json is of the last update", source=run_files.REPORT)
    changed = max(filter(None, (metrics, run_files.modified_at(path / run_files.EVENTS))), default=None)
    if changed is None:
        return RunStatus(state="not started", text="no metrics and no events so far", source="files")
    age = time.time() - changed
    state = RUNNING if age < SILENT_AFTER_S else SILENT
    return RunStatus(state=state, text=f"metrics or events written {_age(age)} ago", source="files")


def _is_reported(path: Path) -> bool:
    """Whether report.json is there, and no later row: a run that was resumed after its report goes on."""
    try:
        report = read_object(path / run_files.REPORT)
    except RunFileError:
        return False
    last = last_row(path / run_files.METRICS) or {}
    return report is not None and report.get("policy_updates") == last.get("update")


def _checked(path: Path) -> Path:
    try:
        resolved = path.resolve(strict=True)
        if not resolved.is_dir():
            raise UserError(f"{path} is no directory; name a run directory, or a directory of runs")
        os.listdir(resolved)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; name a run directory, or a directory of runs") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from error
    return resolved


def _may_come(root: Path) -> bool:
    """An empty directory may get its first run; one that holds other things is a mistake."""
    return not any(root.iterdir())


def _get(config: dict[str, Any], section: str, field: str) -> Any:
    values = config.get(section)
    return values.get(field) if isinstance(values, dict) else None


def _text_of(event: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v}" for k, v in event.items() if k not in ("event", "time"))


def _age(seconds: float) -> str:
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
