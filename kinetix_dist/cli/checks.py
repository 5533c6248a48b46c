"""Checks of arguments that several commands have, before anything slow happens."""

from __future__ import annotations

import os
from pathlib import Path

from kinetix_dist.cli.errors import UserError

MAX_SEED = 2**32 - 1  # what a key of JAX keeps of a seed


def check_seed(seed: int) -> None:
    """Raises `UserError` for a seed that makes no key of its own."""
    if not 0 <= seed <= MAX_SEED:
        raise UserError(f"--seed is {seed}; give a number from 0 to {MAX_SEED}")


def check_output_file(file: Path, option: str = "") -> None:
    """Raises `UserError` where `file` cannot be written; `option` is the flag it was given by, such as "--json"."""
    folder = file.parent
    if file.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        what = f"{option} a file" if option else "a file"
        verb = "give" if option else "name"
        raise UserError(f"cannot write {file}; {verb} {what} in a directory that exists and is writable")
