"""Compiled programs on disk, shared by all runs of a user: the second run of a recipe starts in seconds."""

from __future__ import annotations

import os
from pathlib import Path

OFF = "off"
MIN_COMPILE_SECONDS = 0.3  # programs that compile faster are not worth a file

# Of jax.monitoring. Tracing is left out: its events nest, so that their sum would count it several times.
_COMPILE_EVENTS = ("to_mlir_module_duration", "backend_compile_duration")
_seconds: list[float] = []


def enable_compile_cache(setting: str) -> Path | None:
    """Turns JAX's persistent cache on for this process; returns its directory, None when it is off.

    setting: a directory, "" for `$JAX_COMPILATION_CACHE_DIR` or else the user's cache directory, "off" for no cache.
    """
    import jax

    if not _seconds:
        _seconds.append(0.0)
        jax.monitoring.register_event_duration_secs_listener(_add_event)
    if setting == OFF:
        jax.config.update("jax_enable_compilation_cache", False)
        return None
    directory = Path(setting or os.environ.get("JAX_COMPILATION_CACHE_DIR") or default_directory()).expanduser()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:  # a read-only home is no reason not to train
        return None
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    return directory


def compile_seconds() -> float:
    """Time this process spent lowering and compiling since the cache was enabled; a hit takes little."""
    return _seconds[0] if _seconds else 0.0


def _add_event(event: str, duration: float, **details: object) -> None:
    del details
    if event.startswith("/jax/core/compile/") and event.endswith(_COMPILE_EVENTS):
        _seconds[0] += duration


def default_directory() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kinetix-dist" / "jax"
