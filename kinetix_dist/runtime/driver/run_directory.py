"""Run directory: everything a run is, on disk, and the lock that keeps a second driver out.

    runs/quickstart/
        config.json          the configuration that runs, and its hash
        lock                 held (flock) by the process that drives the run
        checkpoints/         newest good one is where --resume goes on
        metrics/             metrics.jsonl and TensorBoard events
        events.jsonl         what happened: restarts, rejected checkpoints, adopted buffers
        adoptions.json       from which update on each buffer of the curriculum was used
        curriculum/, evaluations.jsonl, processes.jsonl, status.json    for dashboards, see docs/run_data.md
        recordings/          rollouts (.mcap), .rrd and pictures
        logs/                tracebacks of processes that failed, and the last output of those that were lost
        report.json          written when the run is complete

The driver keeps no state of its own: from this directory a run can be resumed by any process.

A disk that is full delays events (`EventLog`) and ends nothing.
"""

from __future__ import annotations

import errno
import fcntl
import glob
import json
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from kinetix_dist.errors import one_line
from kinetix_dist.json_text import json_text
from kinetix_dist.telemetry import curriculum_log
from kinetix_dist.telemetry.event_names import check_event
from kinetix_dist.telemetry.json_lines import (
    append_line,
    damaged_path,
    mend_lines,
    replace_file,
    set_aside_file,
    set_aside_unless_readable,
    utc_text,
)
from kinetix_dist.telemetry.status import STATUS

EVALUATIONS = "evaluations.jsonl"  # evaluations.json has the summaries of three of them
PROCESSES = "processes.jsonl"
LOCK_NAME = "lock"


class RunDirectoryError(Exception):
    """A run directory that cannot be used, and what to do about it."""


def no_run_in(path: Path) -> str:
    """Message for a directory without config.json, and what to do."""
    if not _has_checkpoints(path):
        return f"{path} holds no run (no config.json); start one without --resume"
    return (
        f"{path} has checkpoints but no config.json; write it from the checkpoint.json of one of them, whose "
        '"config" is that of config.json, or choose another --run'
    )


def _has_checkpoints(run: Path) -> bool:
    from kinetix_dist.checkpoint import list_checkpoints  # imports JAX, without which runs are read

    return bool(list_checkpoints(run / "checkpoints"))


def _check_path(path: Path) -> None:
    """Raises RunDirectoryError for a name that Orbax cannot write."""
    try:
        os.fspath(path.absolute()).encode()
    except UnicodeEncodeError:
        raise RunDirectoryError(f"{path!r} is not UTF-8, and checkpoints need that; choose another --run") from None


class RunDirectory:
    """Paths of one run. `create` and `open_existing` take the lock; `close` gives it back."""

    def __init__(self, path: Path, lock: IO[str]) -> None:
        self.path = path
        self.config: dict[str, Any] | None = None  # what config.json holds, once this session has written it
        self.on_event: Callable[[dict[str, Any]], None] = lambda event: None  # takes each event, in any thread
        self._lock = lock
        self._event_log = EventLog(self.events)

    @property
    def config_path(self) -> Path:
        return self.path / "config.json"

    @property
    def report_path(self) -> Path:
        return self.path / "report.json"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def events(self) -> Path:
        return self.path / "events.jsonl"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics"

    @property
    def evaluations_path(self) -> Path:
        return self.path / "evaluations.json"

    @property
    def adoptions_path(self) -> Path:
        return self.path / "adoptions.json"

    @property
    def recordings(self) -> Path:
        return self.path / "recordings"

    @property
    def curriculum(self) -> Path:
        return self.path / curriculum_log.DIRECTORY

    @property
    def outcomes(self) -> Path:
        return self.curriculum / curriculum_log.OUTCOMES

    @property
    def evaluation_rows(self) -> Path:
        return self.path / EVALUATIONS

    @property
    def processes(self) -> Path:
        return self.path / PROCESSES

    @property
    def status(self) -> Path:
        return self.path / STATUS

    @classmethod
    def create(cls, path: Path, *, numbered: bool) -> RunDirectory:
        """Makes a new run directory and locks it.

        Where `path` holds a run already: the next free `path-2`, `path-3` ... if `numbered`, else RunDirectoryError.
        """
        _check_path(path)
        first = path
        for number in range(2, 100_000):
            run = cls._claim(path, first_choice=path == first and not numbered)
            if run is not None:
                return run
            path = first.with_name(f"{first.name}-{number}")
        raise RunDirectoryError(f"no free number is left for {first}; remove old runs")

    @classmethod
    def open_existing(cls, path: Path) -> RunDirectory:
        """Locks a run directory to go on with it."""
        _check_path(path)
        if not (path / "config.json").is_file():
            raise RunDirectoryError(no_run_in(path))
        run = cls(path, lock_directory(path))
        try:
            aside = set_aside_unless_readable(run.events)
            num_damaged = mend_lines(run.events, is_row=lambda row: "event" in row, keep=lambda row: True)
        except OSError as error:
            run.close()
            raise RunDirectoryError(f"cannot write to run directory {path}: {error.strerror}") from error
        if aside is not None:
            run.event("file_set_aside", file=run.events.name, to=aside.name, reason="it cannot be read")
        run.set_aside(run.events, num_damaged)
        return run

    @classmethod
    def _claim(cls, path: Path, *, first_choice: bool) -> RunDirectory | None:
        """Locks `path` if it holds no run yet; None: it does. Raises instead of None for a first choice."""
        try:
            path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise RunDirectoryError(f"{path} is not a directory; choose another with --run") from None
        except OSError as error:
            raise RunDirectoryError(f"cannot write to run directory {path}: {error.strerror}") from error
        try:
            run = cls(path, lock_directory(path))
        except RunInUseError:
            if first_choice:
                raise
            return None
        has_config = run.config_path.exists()
        if not has_config and not _has_checkpoints(path):
            return run
        run.close()
        if not first_choice:
            return None
        if not has_config:
            raise RunDirectoryError(no_run_in(path))
        raise RunDirectoryError(f"{path} holds a run already; go on with it by --resume, or choose another --run")

    def event(self, kind: str, **details: Any) -> None:
        """Appends to events.jsonl: time, kind (of `telemetry.event_names`), details. Never raises for the disk."""
        self.on_event(self._event_log.add(kind, **details))

    def write_pending_events(self) -> None:
        """Tries again what the disk did not take."""
        self._event_log.write_pending()

    def set_aside(self, path: Path, num_lines: int) -> None:
        """Notes that damaged lines of a file of this run were moved to another file next to it."""
        if num_lines:
            names = [str(file.relative_to(self.path)) for file in (path, damaged_path(path))]
            self.event("lines_set_aside", file=names[0], lines=num_lines, to=names[1])

    def write_log(self, name: str, text: str) -> Path:
        """Appends to `logs/NAME.log`; returns its path."""
        path = self.path / "logs" / f"{name}.log"
        path.parent.mkdir(exist_ok=True)
        with path.open("a") as file:
            file.write(f"{utc_text()}\n{text.rstrip()}\n")
        return path

    def try_write_log(self, name: str, text: str) -> Path | None:
        """`write_log` where training goes on: None, with an event, where it cannot be written."""
        try:
            return self.write_log(name, text)
        except OSError as error:
            self.event("file_failed", file=f"logs/{name}.log", error=one_line(error))
            return None

    def write_json(self, path: Path, content: Any) -> None:
        """Writes JSON by a rename: no reader ever sees half a file, and no kill leaves one."""
        replace_file(path, (json_text(content, indent=2) + "\n").encode())

    def read_json(self, path: Path, *, is_whole: Callable[[Any], bool]) -> Any:
        """Reads what `write_json` wrote; None where there is no such file.

        A file that cannot be read, or is not `is_whole`, is renamed, with an event.
        """
        try:
            content = json.loads(path.read_text())
            if is_whole(content):
                return content
            reason = "it holds something else"
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            reason = one_line(error)
        self.event("file_set_aside", file=path.name, to=set_aside_file(path).name, reason=reason)
        return None

    def restore_config(self) -> bool:
        """Writes config.json again where it is gone, without which no run goes on from a checkpoint; says whether it
        was.

        For any thread. Raises OSError, also where the whole directory is gone.
        """
        if not self.path.is_dir():
            raise FileNotFoundError(f"run directory {self.path} is gone; put it back, nothing is saved until then")
        if self.config is None or self.config_path.exists():
            return False
        self.write_json(self.config_path, self.config)
        return True

    def close(self) -> None:
        self._event_log.write_pending()
        self._lock.close()


class RunInUseError(RunDirectoryError):
    """Another driver holds the lock."""


def newest_run(parent: Path, name: str) -> Path | None:
    """The run with the highest number among `name`, `name-2`, `name-3` ... below `parent`; None if there is none."""
    numbered = {}
    for path in parent.glob(f"{glob.escape(name)}*") if parent.is_dir() else []:
        match = re.fullmatch(re.escape(name) + r"(?:-(\d+))?", path.name)
        if match and (path / "config.json").is_file():
            numbered[int(match[1] or 1)] = path
    return numbered[max(numbered)] if numbered else None


def lock_directory(path: Path, option: str = "--run") -> IO[str]:
    """An exclusive flock on a file in `path`; it goes with the process, however that ends. option: that names another
    directory. Raises RunDirectoryError."""
    try:
        file = (path / LOCK_NAME).open("a+")
    except OSError as error:
        if error.errno == errno.EISDIR:
            raise RunDirectoryError(f"{path / LOCK_NAME} is a directory and should be a file; remove it") from None
        raise RunDirectoryError(f"cannot write to run directory {path}: {error.strerror}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.seek(0)
        holder = file.read().strip() or "unknown"
        file.close()
        if error.errno in (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES):
            raise RunInUseError(
                f"run directory {path} is in use by process {holder}; wait for it, or choose another {option}"
            ) from None
        raise RunDirectoryError(f"cannot lock run directory {path}: {error.strerror}") from error
    try:
        file.truncate(0)
        os.write(file.fileno(), f"{os.getpid()}\n".encode())
    except OSError as error:
        file.close()
        raise RunDirectoryError(f"cannot write to run directory {path}: {error.strerror}") from error
    return file


MAX_PENDING = 1000  # events held in memory until they can be written; about 200 kB


class EventLog:
    """Appends events in order, each with the time at which it happened. May be called from any thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._pending: list[dict[str, Any]] = []  # could not be written so far
        self._num_dropped = 0

    def add(self, kind: str, **details: Any) -> dict[str, Any]:
        """Writes an event now, or as soon as the disk takes it, and returns it. Raises UnknownEventError for a kind
        without a name."""
        row = {"time": utc_text(), "event": check_event(kind), **details}
        with self._lock:
            if len(self._pending) < MAX_PENDING:
                self._pending.append(row)
            else:
                self._num_dropped += 1
            self._write()
        return row

    def write_pending(self) -> None:
        """Tries again to write what could not be written."""
        with self._lock:
            self._write()

    def _write(self) -> None:
        try:
            while self._pending:
                append_line(self._path, self._pending[0])
                del self._pending[0]
            if self._num_dropped:
                append_line(self._path, {"time": utc_text(), "event": "events_dropped", "events": self._num_dropped})
                self._num_dropped = 0
        except OSError:
            return  # still pending: nothing is lost while there is memory, and `sink_failing` says what the disk does
