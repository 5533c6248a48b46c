"""Paths that several tests use."""

from __future__ import annotations

import asyncio
import contextlib
import operator
import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any, AnyStr, TypeVar

Result = TypeVar("Result")

REPOSITORY = Path(__file__).resolve().parent.parent
# s: after which something that is waited for is taken to have failed. No test may depend on how fast a machine is, so
# this is far more than one that is busy with other things needs.
PATIENCE_S = 180.0


def python_path() -> str:
    """PYTHONPATH of a test's own processes: this checkout before whatever is there, which may hold its packages."""
    return os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])])


def environment_of_cpus(number: int) -> dict[str, str]:
    """The environment of a test's own process in which JAX has so many devices, all of them this CPU."""
    devices = {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(number)}
    return os.environ | {"PYTHONPATH": python_path()} | devices


@contextlib.contextmanager
def ended_after(process: subprocess.Popen[Any], seconds: float = PATIENCE_S) -> Iterator[None]:
    """Ends a process that takes longer: a read of its output meanwhile comes to the end of the pipe, and not never."""
    timer = threading.Timer(seconds, process.kill)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def next_line(process: subprocess.Popen[AnyStr]) -> AnyStr:
    """Next line on stdout of a process that a test has started; fails where none comes."""
    assert process.stdout is not None
    with ended_after(process):
        line = process.stdout.readline()
    assert line, f"a process said nothing in {PATIENCE_S:g} s, or ended ({process.poll()})"
    return line


def wait_until(condition: Callable[[], object], what: str, *, every: float = 0.02) -> None:
    """Polls until the condition holds; fails after PATIENCE_S, with what was waited for."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {PATIENCE_S:g} s: {what}"
        time.sleep(every)


def run_in_time(main: Coroutine[Any, Any, Result]) -> Result:
    """As `asyncio.run`; raises TimeoutError, at the line that waits, after PATIENCE_S."""
    return asyncio.run(asyncio.wait_for(main, PATIENCE_S))


@contextlib.contextmanager
def compile_cache(directory: Path) -> Iterator[None]:
    """Meanwhile JAX keeps compiled programs there."""
    import jax  # not for whoever needs paths alone

    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(directory))
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def num_compiled(function: Callable[..., object]) -> int:
    """Return the number of programs that JAX has compiled for a jitted function. JAX has no public way to ask."""
    return int(operator.methodcaller("_cache_size")(function))


def public_levels_directory() -> Path | None:
    """The public Kinetix levels (s/, m/, l/ of JSON files) where they are: $KINETIX_LEVELS or beside the checkout."""
    candidates = [os.environ.get("KINETIX_LEVELS"), REPOSITORY.parent / "shared" / "kinetix_levels"]
    for candidate in candidates:
        if candidate and (Path(candidate) / "s").is_dir():
            return Path(candidate)
    return None


def free_port() -> int:
    """A port of loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def present(value: Result | None) -> Result:
    """Return a value that may be None in general, and is not where a test reads it."""
    assert value is not None
    return value
