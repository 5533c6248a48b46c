"""Traces of the processes of a run that others can see: sockets they listen on, command lines, logs."""

from __future__ import annotations

import re
from pathlib import Path

import psutil


def family(pid: int) -> list[psutil.Process]:
    """A process and all that it started."""
    return [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]


def listening(pid: int) -> dict[str, set[str]]:
    """Addresses that a family listens on, with the names of the processes that do, from the kernel's table."""
    found: dict[str, set[str]] = {}
    for process in family(pid):
        for connection in process.net_connections("inet"):
            if connection.status == psutil.CONN_LISTEN:
                found.setdefault(connection.laddr.ip.removeprefix("::ffff:"), set()).add(process.name())
    return found


def places_of(text: str, pid: int) -> list[str]:
    """Command lines of a family, and logs of its Ray session, in which a text stands."""
    lines = {f"command line of {process.pid}": " ".join(process.cmdline()) for process in family(pid)}
    sessions = {found for line in lines.values() for found in re.findall(r"/\S+/session_\d[^/\s]+", line)}
    assert sessions, "no Ray session was found: where are its logs?"
    logs = (log for session in sessions for log in Path(session, "logs").rglob("*") if log.is_file())
    found = [name for name, line in lines.items() if text in line]
    return found + [str(log) for log in logs if text in log.read_text(errors="replace")]
