"""Compiled programs on disk, shared by all runs of a user: the second run of a recipe starts in seconds."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

from kinetix_dist.telemetry.compile_time import count_compile_seconds

OFF = "off"
MIN_COMPILE_SECONDS = 0.3  # programs that compile faster are not worth a file, unless the environment says otherwise
MIN_COMPILE_VARIABLE = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"  # JAX reads it itself


def enable_compile_cache(setting: str) -> Path | None:
    """Turns JAX's persistent cache on for this process; returns its directory, None when it is off or cannot be
    written.

    setting: a directory, "" for `$JAX_COMPILATION_CACHE_DIR` or else the user's cache directory, "off" for no cache.
    """
    import jax

    count_compile_seconds()
    if setting == OFF:
        jax.config.update("jax_enable_compilation_cache", False)
        return None
    directory = directory_of(setting)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError:  # a read-only home is no reason not to train; commands say so (`cli/computing.py`)
        return None
    jax.config.update("jax_compilation_cache_dir", str(directory))
    if MIN_COMPILE_VARIABLE not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    _let_every_rank_write()
    return directory


def _let_every_rank_write() -> None:
    """On CPUs. JAX lets process 0 of a group write alone, but names programs by the topology as a process sees it, and
    that differs from rank to rank there: ranks above 0 would compile at every start. So they write their own."""
    import jax
    from jax._src import compiler, distributed  # there is no public way (jax 0.10)

    write = compiler._cache_write
    if write.__name__ == "write_as_process_0":  # enabled twice
        return

    def write_as_process_0(*arguments: Any, **options: Any) -> None:
        if jax.default_backend() != "cpu":
            return write(*arguments, **options)
        rank, distributed.global_state.process_id = distributed.global_state.process_id, 0
        try:
            return write(*arguments, **options)
        finally:
            distributed.global_state.process_id = rank

    compiler._cache_write = write_as_process_0


def directory_of(setting: str) -> Path:
    """Directory of the cache by its setting, which is not "off"."""
    return Path(setting or os.environ.get("JAX_COMPILATION_CACHE_DIR") or default_directory()).expanduser()


def default_directory() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kinetix-dist" / "jax"
