"""status.json: what is written is read back, and a run that says it is running is judged by its process and its age."""

import dataclasses
import os
import socket
import subprocess
import sys

import pytest

from kinetix_dist.telemetry.json_lines import utc_seconds, utc_text
from kinetix_dist.telemetry.status import (
    FAILED,
    RUNNING,
    SILENT,
    STATUS,
    Status,
    StatusError,
    judged,
    read_status,
    write_status,
)

NOW = 1_800_000_000.0
HERE = Status(
    phase="training",
    pid=os.getpid(),
    host=socket.gethostname(),
    session=2,
    started=utc_text(NOW - 3600),
    time=utc_text(NOW),
    update=40,
    env_steps=1000,
    total_env_steps=2000,
    seconds_left=60.0,
    update_seconds=0.5,
)
ELSEWHERE = dataclasses.replace(HERE, host="another", pid=1)


def test_what_is_written_is_read_back_by_a_rename(tmp_path):
    path = tmp_path / STATUS
    assert read_status(path) is None
    write_status(path, HERE)
    before = path.stat().st_ino
    write_status(path, dataclasses.replace(HERE, update=41))
    assert read_status(path) == dataclasses.replace(HERE, update=41) and path.stat().st_ino != before
    assert [*tmp_path.iterdir()] == [path]


def test_times_are_utc():
    assert utc_text(0) == "1970-01-01T00:00:00Z" and utc_seconds("1970-01-02T00:00:01Z") == 86401.0


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"format": 1}', b'{"format": 7}', b"[" * 100_000])
def test_a_damaged_file_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / STATUS
    path.write_bytes(content)
    with pytest.raises(StatusError) as caught:
        read_status(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "changes, age, expected",
    [
        ({}, 59, RUNNING),
        ({}, 61, SILENT),
        ({"update_seconds": 30.0}, 299, RUNNING),  # ten updates
        ({"update_seconds": 30.0}, 301, SILENT),
        ({"phase": "compiling"}, 1799, RUNNING),
        ({"phase": "compiling"}, 1801, SILENT),
        ({"state": FAILED}, 1e6, FAILED),
    ],
)
def test_a_run_elsewhere_is_silent_after_ten_updates_or_a_minute(changes, age, expected):
    assert judged(dataclasses.replace(ELSEWHERE, **changes), NOW + age) == expected


def test_a_run_on_this_host_is_silent_once_its_process_is_gone():
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    status = dataclasses.replace(HERE, pid=process.pid)
    assert judged(status, NOW) == RUNNING
    process.communicate(b"\n")
    assert judged(status, NOW) == SILENT
