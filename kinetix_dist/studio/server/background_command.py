"""A `kinetix-dist` command as a child process of the server: at low priority, on the CPU, ended with the server.

    command = await BackgroundCommand.start(["finetune", "--levels", "mine.json"])
    status = await command.wait()
    command.last_line         the last line that it printed: its result, or why it ended
    await command.end()       SIGTERM, then SIGKILL

The child has a process group of its own, which gets no Ctrl-C of the terminal and is ended as a whole.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import Sequence

from kinetix_dist.child_python import command_of

NICE = 10  # as the engine worker
END_SECONDS = 3.0  # for a command to end in order
LOG_BYTES = 8192  # of its output, for its last lines
PROGRAM = "kinetix-dist"


class BackgroundCommand:
    """One command, from its start to its end. All methods are called in the event loop."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self._log = b""
        self._reading = asyncio.create_task(self._read())

    @classmethod
    async def start(cls, words: Sequence[str], *, module: str = "kinetix_dist.cli.main") -> BackgroundCommand:
        """Starts `kinetix-dist WORDS`. module: another program, for tests. Raises OSError."""
        becomes = command_of(module, *words)
        process = await asyncio.create_subprocess_exec(
            *command_of("kinetix_dist.parent_death", os.getpid(), NICE, *becomes),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=os.environ | {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""},
            start_new_session=True,
        )
        return cls(process)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def lines(self) -> list[str]:
        """The last lines of its output, without the name of the program that begins an error."""
        text = self._log.decode(errors="replace").replace("\r", "\n")
        return [line.removeprefix(f"{PROGRAM}: ").strip() for line in text.split("\n") if line.strip()]

    @property
    def last_line(self) -> str:
        return self.lines[-1] if self.lines else "it printed nothing"

    async def wait(self) -> int:
        """Its exit status, once it has ended; negative: of a signal."""
        status = await self._process.wait()
        await asyncio.shield(self._reading)  # others may wait too
        return status

    async def end(self) -> None:
        """Ends it, in order if it does so within END_SECONDS. Does nothing where it has ended."""
        self._signal(signal.SIGTERM)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._process.wait(), END_SECONDS)
        self._signal(signal.SIGKILL)  # also children that it left behind
        with contextlib.suppress(TimeoutError):  # one in a process group of its own may keep the output open
            await asyncio.wait_for(self.wait(), END_SECONDS)

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    async def _read(self) -> None:
        assert self._process.stdout is not None
        while part := await self._process.stdout.read(4096):
            self._log = (self._log + part)[-LOG_BYTES:]
