"""The start of a command that computes: what JAX has to be like, and where compiled programs are kept."""

from __future__ import annotations

import functools
import sys

from kinetix_dist import user_directories
from kinetix_dist.cli.last_words import say
from kinetix_dist.jax_arithmetic import check_arithmetic
from kinetix_dist.jax_settings import check_settings


def start_computing(compile_cache: str = "") -> None:
    """Before a command computes anything, and after JAX was held to the CPU where it has to be.

    Raises UserError for a JAX that computes wrongly, or has settings with which commands do not run. compile_cache: as
    `enable_compile_cache` takes it. Says in one line where caches are not where they were to be.
    """
    from kinetix_dist.program_cache import OFF, enable_compile_cache

    check_settings()
    check_arithmetic()
    if said := user_directories.settle():
        _say(said)
    if enable_compile_cache(compile_cache) is None and compile_cache != OFF:
        _say(
            "the compile cache cannot be written: programs are compiled again by every command; set "
            "JAX_COMPILATION_CACHE_DIR to a directory that can"
        )


@functools.cache  # once a command, which may start to compute in two places
def _say(line: str) -> None:
    say(f"kinetix-dist: {line}", sys.stderr)
