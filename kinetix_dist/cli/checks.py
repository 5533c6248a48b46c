"""Checks before a command does anything slow: its arguments, JAX, and the directories of caches."""

from __future__ import annotations

import functools
import os
import sys
from pathlib import Path

from kinetix_dist import user_directories
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, shortened
from kinetix_dist.jax_checks import check_arithmetic, check_settings

MAX_SEED = 2**32 - 1  # a key of JAX keeps 32 bits of a seed


def check_seed(seed: int) -> None:
    """Raise `UserError` for a seed whose key equals the key of another seed."""
    if not 0 <= seed <= MAX_SEED:
        raise UserError(f"--seed is {seed}; give a number from 0 to {MAX_SEED}")


def check_count(name: str, value: float | None, most: int) -> None:
    """Raise `UserError` for a count that is not in 1 to `most`. None: the option was left out."""
    if value is not None and not 1 <= value <= most:
        limit = "it must be 1 or more" if value < 1 else f"give {most:,} or less"
        text = f"{value:g}" if isinstance(value, float) else shortened(str(value), 30)
        raise UserError(f"--{name.replace('_', '-')} is {text}; {limit}")


def check_output_file(file: Path, option: str = "") -> None:
    """Raise `UserError` if `file` cannot be written. `option` is the flag that names it, such as "--json"."""
    folder = file.parent
    if file.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        what = f"{option} a file" if option else "a file"
        verb = "give" if option else "name"
        raise UserError(f"cannot write {file}; {verb} {what} in a directory that exists and is writable")


def check_output_directory(directory: Path, option: str = "") -> None:
    """Raise `UserError` if `directory` is a file, lies below a file, or cannot be written.

    The directory need not exist. `option` is the flag that names it, such as "--out".
    """
    nearest = next(path for path in (directory, *directory.absolute().parents) if os.path.lexists(path))
    named = f"{option} {directory}".lstrip() + ("" if nearest == directory else f" is below {nearest}, which")
    if not nearest.is_dir():
        raise UserError(f"{named} is a file; give a directory")
    if not os.access(nearest, os.W_OK):
        raise UserError(f"{named} is not writable; give another directory")


def start_computing(compile_cache: str = "") -> None:
    """Check JAX and set up the caches. Commands call it after they restrict JAX to the CPU, before they compute.

    A line on stderr reports a cache that could not be created in its configured place.

    Args:
        compile_cache: as `enable_compile_cache` takes it.

    Raises:
        UserError: JAX computes wrongly, or has settings with which commands do not run.
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
