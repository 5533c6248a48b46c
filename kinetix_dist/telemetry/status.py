"""status.json of a run: whether it goes on, how far it is, why it ended. docs/run_data.md describes every field."""

from __future__ import annotations

import dataclasses
import os
import socket
import time
from pathlib import Path
from typing import Any, get_type_hints

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.json_text import json_text
from kinetix_dist.telemetry.json_lines import utc_seconds
from kinetix_dist.text_files import loads_json

FORMAT = 1
STATUS = "status.json"
RUNNING, FINISHED, STOPPED, FAILED = STATES = ("running", "finished", "stopped", "failed")
SILENT = "silent"  # state, for readers, of a run that says it is running and writes nothing more
SILENT_AFTER_S = 60.0
SILENT_AFTER_UPDATES = 10
SILENT_AFTER_OTHER_PHASES_S = 1800.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Status:
    """Content of status.json."""

    format: int = FORMAT
    state: str = RUNNING  # of STATES
    phase: str  # "starting", "evaluating", "compiling", "imitating", "curating", "training", "recording" or "done"
    pid: int
    host: str
    session: int  # 1, and 1 more with every resume
    started: str  # UTC, of this session
    time: str  # UTC, when it was written
    update: int | None  # updates done; None before the first one of the session
    env_steps: int | None
    total_env_steps: int  # at which the run ends; 0: it ends by time
    seconds_left: float | None
    update_seconds: float | None  # that the last update took, everything included
    error: str | None = None  # the line that the command ended with


class StatusError(ValueError):
    """A status.json that is damaged, or of another format; which, in one line."""


def write_status(path: Path, status: Status) -> None:
    """Replaces the file by a rename. Raises OSError."""
    replace_file(path, (json_text(dataclasses.asdict(status)) + "\n").encode())


def read_status(path: Path) -> Status | None:
    """None where there is no file: an older run, or one that has not started. Raises StatusError, and OSError where it
    cannot be read."""
    try:
        content = loads_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise StatusError(f"{path} is damaged: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else None
        raise StatusError(f"{path} has format {found}; this version reads format {FORMAT}")
    types = get_type_hints(Status)
    try:
        status = Status(
            **{name: _checked(name, value, types[name]) for name, value in content.items() if name in types}
        )
        utc_seconds(status.time)
        utc_seconds(status.started)
    except (TypeError, ValueError) as error:
        raise StatusError(f"{path} is damaged: {error}") from None
    if status.state not in STATES:
        raise StatusError(f"{path} is damaged: state {status.state} is none of {', '.join(STATES)}")
    return status


def _checked(name: str, value: Any, expected: Any) -> Any:
    """The value of a field. Raises TypeError where it is of another type; an integer is a float, too."""
    if isinstance(value, expected) or (isinstance(value, int) and isinstance(float(value), expected)):
        return value
    raise TypeError(f"{name} is {value!r:.40}, not {getattr(expected, '__name__', expected)}")


def judged(status: Status, now: float | None = None) -> str:
    """One of STATES, or SILENT: it says that it is running, but its process is gone from this host, or it has written
    nothing for longer than its phase explains. now: s since the epoch."""
    if status.state != RUNNING:
        return status.state
    if status.host == socket.gethostname() and not _is_alive(status.pid):
        return SILENT
    age = (time.time() if now is None else now) - utc_seconds(status.time)
    return SILENT if age > silent_after_seconds(status) else RUNNING


def silent_after_seconds(status: Status) -> float:
    """Seconds without a new status after which a run may be lost. Phases but training compile, or play for long."""
    if status.phase != "training" or status.update_seconds is None:
        return SILENT_AFTER_OTHER_PHASES_S
    return max(SILENT_AFTER_S, SILENT_AFTER_UPDATES * status.update_seconds)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # of another user
        return True
    except OverflowError:  # no process has such a number
        return False
    return True
