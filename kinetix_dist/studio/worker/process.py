"""The process of the engine worker: `python -m kinetix_dist.studio.worker.process`.

Requests come on standard input, replies go to standard output (docs/play_protocol.md). The process ends when its input
closes, when its parent is gone, or after IDLE_SECONDS without work. What libraries print goes to standard error.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from typing import IO

import psutil

from kinetix_dist.child_python import imported_from
from kinetix_dist.studio.worker.wire import PROTOCOL_VERSION, ProtocolError, read

IDLE_SECONDS = 900.0
IDLE_VARIABLE = "KINETIX_DIST_WORKER_IDLE_SECONDS"  # another number of seconds, for tests
NICE = 10
NUM_THREADS = 2
MAX_ARENAS = 2  # of glibc; by its own 8 a core, what compiling frees lies in each of them: 5 % more memory
M_ARENA_MAX = -8  # malloc.h
WATCH_SECONDS = 0.5
MAX_RESIDENT_BYTES = 800_000_000  # above it an unused worker frees its programs,
RELEASE_SECONDS = 30.0  # after so long without a message
CLOSE_SECONDS = 2.0  # for the last messages


def main() -> None:
    parent = os.getppid()
    pipe = _take_stdout()
    _prepare_process()
    # jax is imported below this line, once the process is prepared for it.
    from kinetix_dist.errors import UserError
    from kinetix_dist.jax_checks import check_arithmetic, check_settings

    try:
        check_settings()
        check_arithmetic()
    except UserError as error:
        sys.exit(str(error))  # the server shows it
    from kinetix_dist.program_cache import enable_compile_cache
    from kinetix_dist.studio.worker.programs import release_programs
    from kinetix_dist.studio.worker.service import Service, hello
    from kinetix_dist.studio.worker.wire import Outbox

    enable_compile_cache("")
    outbox = Outbox(pipe)
    service = Service(outbox)
    outbox.send(
        {"type": "hello", "version": PROTOCOL_VERSION, "pid": os.getpid(), "imports": imported_from(), **hello()}
    )
    last_message = [time.monotonic()]

    def end(reason: str) -> None:
        """Exits at once: threads may be in the middle of a program whose result is not needed."""
        if reason == "idle":
            outbox.send({"type": "bye", "reason": reason})
        outbox.close(CLOSE_SECONDS)
        os._exit(0)

    def watch() -> None:
        process = psutil.Process()
        idle_seconds = float(os.environ.get(IDLE_VARIABLE, IDLE_SECONDS))
        while True:
            time.sleep(WATCH_SECONDS)
            if os.getppid() != parent:
                os._exit(0)
            if service.is_busy:
                last_message[0] = time.monotonic()
            elif time.monotonic() - last_message[0] > idle_seconds:
                end("idle")
            elif service.is_unused and time.monotonic() - last_message[0] > RELEASE_SECONDS:
                if process.memory_info().rss > MAX_RESIDENT_BYTES:
                    release_programs()

    threading.Thread(target=watch, name="watch", daemon=True).start()
    while True:
        try:
            message = read(sys.stdin.buffer)
        except ProtocolError as error:
            outbox.send({"type": "error", "code": error.code, "text": str(error)})
            continue
        if message is None:
            end("closed")
        else:
            last_message[0] = time.monotonic()
            service.handle(message)


def _take_stdout() -> IO[bytes]:
    """Pipe to the client. Other writes to standard output go to standard error from now on."""
    pipe = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return pipe


def _prepare_process() -> None:
    """Limits the process to the CPU, at low priority. Warp looks for GPUs by itself: it finds none."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    os.environ["NPROC"] = str(NUM_THREADS)  # threads of XLA's pool
    os.nice(NICE)
    if sys.platform == "linux":
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, MAX_ARENAS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends this process


if __name__ == "__main__":
    main()
