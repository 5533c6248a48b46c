"""Index of the runs below the paths that a person named, with the status of each.

A path is a run or a directory of runs (two levels deep). Runs that appear later are found; removed ones are left
out. A run that links lead to as well is one run. Its name in addresses is that of its directory (`address_name`), made
unique if two have the same.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.errors import UserError, one_line
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.address_names import address_name
from kinetix_dist.studio.runs.evaluations import newest_rates
from kinetix_dist.studio.runs.run_files import RunFileError, last_row, read_object
from kinetix_dist.telemetry.json_lines import utc_seconds
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row
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

DEPTH = 2  # levels of directories below a path in which runs are looked for
MAX_RUNS = 5000

SETTINGS_OF_CONFIG = {  # by their names in the table of runs: section, field, type
    "name": ("run", "name", str),
    "size": ("env", "size", str),
    "curriculum": ("curriculum", "name", str),
    "placement": ("run", "placement", str),
    "total_env_steps": ("run", "total_env_steps", int),
}
SETTINGS = ("hash", *SETTINGS_OF_CONFIG)

NO_RUN = "is no run (it has no config.json) and holds none; name a run directory, or a directory of runs"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunStatus:
    """Status of a run, its reason in one line, and its source. Fields that status.json lacks are None."""

    state: str  # "running", "silent", "finished", "stopped", "failed" or "not started"
    text: str
    source: str  # the file it was read from; "files" where it follows from their times
    phase: str | None = None
    update: int | None = None
    env_steps: int | None = None
    seconds_left: float | None = None
    time: float | None = None  # unix time s at which the source was written
    problem: str | None = None  # of the status file

    @property
    def is_over(self) -> bool:
        """It writes nothing more, unless it is resumed."""
        return self.state in (FINISHED, STOPPED, FAILED, SILENT)


class RunIndex:
    """Index of runs, updated by `scan`. Ids stay with their directories."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Raises UserError for a path that does not exist, is no directory, or holds neither run nor directory."""
        self._roots = [_checked(path) for path in paths]
        self._ids: dict[Path, str] = {}
        self.runs: dict[str, Path] = {}
        self.problems: list[str] = []
        self.scan()
        for root in self._roots:
            if not any(run.is_relative_to(root) for run in self.runs.values()) and not _may_come(root):
                raise UserError(f"{root} {NO_RUN}")

    def add(self, path: Path) -> None:
        """Adds a path, once. Raises UserError as for those of the start."""
        root = _checked(path)
        if root not in self._roots:
            self._roots.append(root)

    def scan(self) -> dict[str, Path]:
        """Ids and directories of the runs that exist now."""
        self.problems = []
        runs: dict[Path, Path] = {}  # by the place that links lead to
        for root in self._roots:
            for path in self._runs_below(root, DEPTH):
                place = path.resolve()
                if place not in runs or place == path:
                    runs[place] = path
        if len(runs) > MAX_RUNS:
            self.problems.append(f"more than {MAX_RUNS} runs; name fewer directories")
        self.runs = {self._id_of(path): path for path in [*runs.values()][:MAX_RUNS]}
        return self.runs

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
            own, number, taken = address_name(path.name), 1, set(self._ids.values())
            name = own
            while name in taken:
                number += 1
                name = f"{own}~{number}"
            self._ids[path] = name
        return self._ids[path]


def summary(run_id: str, path: Path) -> dict[str, Any]:
    """Row of the table of runs, from small files. `problems`: a line for each unreadable or damaged file."""
    problems: list[str | None] = []

    def read(of_run: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
        try:
            return of_run(path)
        except RunFileError as error:
            problems.append(str(error))
            return {}

    settings = read(_settings)
    last = last_row(path / run_files.METRICS, is_row=is_metrics_row)
    status = status_of(path)
    problems += [last.problem, status.problem]
    return {
        "id": run_id,
        "path": str(path),
        **{name: settings.get(name) for name in SETTINGS},
        "status": dataclasses.asdict(status),
        "modified": run_files.modified_at(path / run_files.METRICS) or run_files.modified_at(path / run_files.CONFIG),
        "last": None if last.row is None else {k: v for k, v in last.row.items() if isinstance(v, int | float)},
        "evaluated": read(newest_rates),
        "problems": [*dict.fromkeys(problem for problem in problems if problem is not None)],
    }


def _settings(path: Path) -> dict[str, Any]:
    """Fields of config.json for the table. Raises RunFileError."""
    content = read_object(path / run_files.CONFIG) or {}
    config = run_files.member(content, "config", dict, file=run_files.CONFIG) or {}
    found: dict[str, Any] = {"hash": run_files.member(content, "hash", str, file=run_files.CONFIG)}
    for name, (section, field, kind) in SETTINGS_OF_CONFIG.items():
        values = run_files.member(config, section, dict, file=run_files.CONFIG) or {}
        found[name] = run_files.member(values, field, kind, file=run_files.CONFIG)
    return found


def status_of(path: Path) -> RunStatus:
    """Status of a run by its status.json, else by other files and their times."""
    try:
        status = read_status(path / run_files.STATUS)
    except (StatusError, OSError) as error:
        problem = one_line(error).replace(f"{path / run_files.STATUS}", run_files.STATUS)
        return dataclasses.replace(_status_by_files(path), text=problem, problem=problem)
    if status is None:
        return _status_by_files(path)
    state = judged(status)
    written_at = utc_seconds(status.time)
    age = _age(time.time() - written_at)
    text = {
        RUNNING: f"{status.phase}, written {age} ago by process {status.pid} on {status.host}",
        SILENT: f"no status for {age}, last in {status.phase} (process {status.pid} on {status.host})",
    }.get(state, status.error or f"ended {age} ago")
    return RunStatus(
        state=state,
        text=text,
        source=run_files.STATUS,
        phase=status.phase,
        update=status.update,
        env_steps=status.env_steps,
        seconds_left=status.seconds_left if state == RUNNING else None,
        time=written_at,
    )


def _status_by_files(path: Path) -> RunStatus:
    files = (run_files.METRICS, run_files.EVENTS)
    changed = max(filter(None, (run_files.modified_at(path / name) for name in files)), default=None)
    last_event = last_row(path / run_files.EVENTS, is_row=run_files.is_event).row or {}
    if last_event.get("event") in ("run_failed", "stopped"):
        state = FAILED if last_event["event"] == "run_failed" else STOPPED
        return RunStatus(state=state, text=_text_of(last_event), source=run_files.EVENTS, time=changed)
    if _is_reported(path):
        text = "report.json is of the last update"
        return RunStatus(state=FINISHED, text=text, source=run_files.REPORT, time=changed)
    if changed is None:
        return RunStatus(state="not started", text="no metrics and no events so far", source="files")
    age = time.time() - changed
    state = RUNNING if age < SILENT_AFTER_S else SILENT
    text = f"metrics or events written {_age(age)} ago"
    return RunStatus(state=state, text=text, source="files", time=changed)


def _is_reported(path: Path) -> bool:
    """True where report.json is of the last row: a run that was resumed after its report goes on."""
    try:
        report = read_object(path / run_files.REPORT)
    except RunFileError:
        return False
    last = last_row(path / run_files.METRICS, is_row=is_metrics_row).row or {}
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
    """True for an empty directory, which may get its first run; a directory of other files is a mistake."""
    return not any(root.iterdir())


def _text_of(event: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v}" for k, v in event.items() if k not in ("event", "time"))


def _age(seconds: float) -> str:
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
