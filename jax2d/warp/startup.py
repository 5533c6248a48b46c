"""Start of Warp in a process: the folder of its compiled kernels, and its messages."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import tempfile
import threading
from collections.abc import Generator

import warp as wp

# Warp's library writes this line to descriptor 2 on every machine without a GPU, whatever its log level.
_NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"
_READ_BYTES = 1 << 20
_one_at_a_time = threading.Lock()  # `functools.cache` lets two threads run what is not cached yet


@functools.cache
def start() -> None:
    """Initialises Warp, without its line about a missing GPU: JAX reports that itself.

    A process without a home directory keeps kernels in a temporary directory of its own: Warp would make one that is
    called `~`.
    """
    names_a_directory = "WARP_CACHE_PATH" in os.environ or "XDG_CACHE_HOME" in os.environ
    if wp.config.kernel_cache_dir is None and not names_a_directory and not os.path.isabs(os.path.expanduser("~")):
        wp.config.kernel_cache_dir = tempfile.mkdtemp(prefix="jax2d-warp-")
    with _one_at_a_time, without_line_about_no_driver():
        wp.init()


@contextlib.contextmanager
def without_line_about_no_driver() -> Generator[None]:
    """Passes on whatever is written to descriptor 2 inside, at the end, but for the line about a missing driver.

    Not for two threads at once: descriptors belong to the process. A child that another thread starts meanwhile
    inherits the pipe; it is not waited for.
    """
    try:
        stderr = os.dup(2)
    except OSError:  # it is closed: that line has no reader
        yield
        return
    if sys.stderr is not None:
        sys.stderr.flush()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)  # more than a pipe holds would be lost rather than wait for us
    os.set_blocking(reading, False)
    os.dup2(writing, 2)
    os.close(writing)
    try:
        yield
    finally:
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(stderr, 2)  # the last descriptor of the pipe to write to
        os.close(stderr)
        with os.fdopen(reading, "rb") as pipe:
            said = pipe.read(_READ_BYTES) or b""
        os.write(2, b"".join(line for line in said.splitlines(keepends=True) if not line.startswith(_NO_DRIVER)))
