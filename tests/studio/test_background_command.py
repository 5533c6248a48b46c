"""Commands in the background of the server: their output, their priority, and their end in every case."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from kinetix_dist.studio.server import background_command
from kinetix_dist.studio.server.background_command import NICE, BackgroundCommand
from tests.helpers import PATIENCE_S, REPOSITORY, next_line, python_path, run_in_time
from tests.studio.serving import wait_for

STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
print(child.pid, flush=True)
time.sleep(600)
"""
# A server: starts the command, says which process that is, and waits.
SERVER = """
import asyncio, sys
from kinetix_dist.studio.server.background_command import BackgroundCommand
async def main():
    command = await BackgroundCommand.start([], module=sys.argv[1])
    print(command.pid, flush=True)
    await command.wait()
asyncio.run(main())
"""


def is_running(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def script(tmp_path: Path, text: str) -> str:
    path = tmp_path / "command.py"
    path.write_text(text)
    return str(path)


def test_a_command_has_its_words_a_low_priority_and_no_gpu(tmp_path: Path) -> None:
    text = """
import os, sys
print(sys.argv[1:], os.nice(0), os.environ["JAX_PLATFORMS"], repr(os.environ["CUDA_VISIBLE_DEVICES"]))
"""

    async def run() -> None:
        command = await BackgroundCommand.start(["levels", "--a b"], module=script(tmp_path, text))
        assert await command.wait() == 0
        nice = min(os.nice(0) + NICE, 19)
        assert command.lines == [f"['levels', '--a b'] {nice} cpu ''"]

    run_in_time(run())


def test_a_command_that_fails_has_its_status_and_its_last_line(tmp_path: Path) -> None:
    text = "import sys; print('begins'); print('kinetix-dist: no space', file=sys.stderr); sys.exit(3)"

    async def run() -> None:
        command = await BackgroundCommand.start([], module=script(tmp_path, text))
        assert await command.wait() == 3
        assert "no space" in command.lines and command.last_line in ("no space", "begins")

    run_in_time(run())


def test_a_command_that_does_not_end_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background_command, "END_SECONDS", 0.3)

    async def run() -> None:
        command = await BackgroundCommand.start([], module=script(tmp_path, STUBBORN))
        while not command.lines:
            await asyncio.sleep(0.02)
        child = int(command.lines[0])
        assert is_running(child)
        await command.end()
        assert not is_running(command.pid)
        await asyncio.to_thread(wait_for, lambda: not is_running(child))
        await command.end()  # has ended already

    run_in_time(run())


def test_a_process_that_left_its_group_with_the_output_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until Python 3.12 asyncio itself waits for the end of the output, where a process has ended."""
    monkeypatch.setattr(background_command, "END_SECONDS", 0.3)
    text = STUBBORN.replace('time.sleep(600)"])', 'time.sleep(600)"], start_new_session=True)')

    async def run() -> None:
        command = await BackgroundCommand.start([], module=script(tmp_path, text))
        while not command.lines:
            await asyncio.sleep(0.02)
        child = psutil.Process(int(command.lines[0]))
        try:
            await command.end()
            assert not is_running(command.pid) and is_running(child.pid)
        finally:
            child.kill()
        assert await command.wait() == -signal.SIGKILL

    run_in_time(run())


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_command_ends_with_the_server(tmp_path: Path, number: signal.Signals) -> None:
    sleeper = script(tmp_path, "import time; time.sleep(600)")
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER, sleeper],
        stdout=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
        env=os.environ | {"PYTHONPATH": python_path()},
    )
    pid = int(next_line(server))
    wait_for(lambda: str(sleeper) in " ".join(psutil.Process(pid).cmdline()))
    server.send_signal(number)
    server.wait(PATIENCE_S)
    wait_for(lambda: not is_running(pid))
