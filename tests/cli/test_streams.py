"""Standard streams that are closed, without a reader, or that take ASCII alone."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import pytest

from kinetix_dist.cli.streams import _for_any_reader, say
from tests.cli.test_main import run_command
from tests.helpers import PATIENCE_S, REPOSITORY

COMMAND = [sys.executable, "-m", "kinetix_dist"]


def _pipe_without_reader():
    reads, writes = os.pipe()
    os.close(reads)
    return writes


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_leaves_early_is_no_failure(unbuffered):
    """Pipes like `kinetix-dist levels list | head -1` close early."""
    writes = _pipe_without_reader()
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(
        [*COMMAND, "levels", "list"],
        stdout=writes, stderr=subprocess.PIPE, env=environment, cwd=REPOSITORY, timeout=PATIENCE_S,
    )  # fmt: skip
    os.close(writes)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_closed_streams_are_no_failure(closed, tmp_path):
    """Nor does a file that the command opens get the number of one of them, and what is printed."""
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}', "sh", *COMMAND, "--version"],
        cwd=REPOSITORY, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0 and done.stderr == ""
    assert ("kinetix-dist" in done.stdout) == (not closed.startswith(">"))


def test_a_closed_stderr_leaves_the_exit_status_of_a_mistake():
    command = ["sh", "-c", 'exec "$@" 2>&-', "sh", *COMMAND, "trian"]
    assert subprocess.run(command, cwd=REPOSITORY, timeout=PATIENCE_S).returncode == 2


@pytest.mark.parametrize("arguments", [["levels", "--help"], ["levels", "list"]])
def test_what_ascii_cannot_show_is_replaced(arguments, monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    done = run_command(*arguments)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.isascii() and len(done.stdout) > 200


def test_a_stream_drops_what_nobody_reads_also_when_it_is_flushed():
    pipe = io.TextIOWrapper(os.fdopen(_pipe_without_reader(), "wb"), encoding="ascii")
    stream = _for_any_reader(pipe)
    print("one \u2022", file=stream, flush=True)
    stream.write("two" * 10_000)
    stream.flush()


def test_last_words_are_in_the_encoding_of_their_stream(tmp_path):
    reads, writes = os.pipe()
    with os.fdopen(writes, "w", encoding="ascii") as stream:
        say("a \u2022 b", stream)
    with os.fdopen(reads, "rb") as pipe:
        assert pipe.read() == b"a ? b\n"


HOSTILE = "\x1b]0;mine\x07\x1b[2J\x9b2J\r\u202e"


def test_control_characters_in_names_of_files_reach_no_terminal(tmp_path):
    level = tmp_path / f"level{HOSTILE}.json"
    level.write_bytes((REPOSITORY / "levels/s/hop_home.json").read_bytes())
    for arguments in (["levels", "list"], ["levels", "validate", "--no-play"], ["levels", "export"]):
        done = subprocess.run(
            [*COMMAND, *arguments, str(tmp_path)], cwd=REPOSITORY, capture_output=True, text=True, timeout=PATIENCE_S
        )
        shown = done.stdout + done.stderr
        assert shown and not set(HOSTILE) - set("]0;mine[2J") & set(shown), shown


def test_a_terminal_gets_colours_and_nothing_else(tmp_path):
    controller, terminal = os.openpty()
    with os.fdopen(terminal, "w", closefd=True) as opened:
        stream = _for_any_reader(opened)
        print(f"\x1b[31mred\x1b[0m {HOSTILE}", file=stream, flush=True)
        say(f"\x1b[1mbold\x1b[0m {HOSTILE}", stream)
        shown = b""
        while shown.count(b"\n") < 2:
            shown += os.read(controller, 1000)
    os.close(controller)
    escaped = r"\x1b]0;mine\x07\x1b[2J\x9b2J\r\u202e"
    assert shown.decode().split("\r\n")[:2] == [f"\x1b[31mred\x1b[0m {escaped}", f"\x1b[1mbold\x1b[0m {escaped}"]


def test_a_pipe_gets_no_colours():
    reads, writes = os.pipe()
    with os.fdopen(writes, "w") as stream:
        say("\x1b[31mred", stream)
    with os.fdopen(reads, "rb") as pipe:
        assert pipe.read() == b"\\x1b[31mred\n"
