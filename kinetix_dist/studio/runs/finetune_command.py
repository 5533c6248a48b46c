"""Command lines that train on evaluated levels, for a terminal: a set by its name, or level files of an archive."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

CHECKPOINTS = "checkpoints"  # directory of a run


def finetune_lines(run: Path, levels: str, *, archive: str | None) -> list[str]:
    """Lines for a shell: `finetune` from the newest checkpoint of a run, from scratch where it has none.

    levels: a set, or the directory that the lines unpack the archive into.
    """
    words = ["kinetix-dist", "finetune"]
    if has_checkpoint(run):
        words += ["--from", str(run.resolve())]
    words += ["--levels", levels, "--run", f"runs/finetune-{plain_name(levels)}"]
    unpack = [] if archive is None else [shlex.join(["python3", "-m", "zipfile", "-e", archive, levels])]
    return [*unpack, " ".join(map(_quoted, words))]


def _quoted(word: str) -> str:
    """Return a word for a shell, in printable characters also if it holds bytes that are not UTF-8."""
    if word.isprintable():
        return shlex.quote(word)
    return "$'" + "".join(f"\\x{byte:02x}" for byte in os.fsencode(word)) + "'"


def has_checkpoint(run: Path) -> bool:
    """True where a run has written a checkpoint; it may be damaged, which `finetune` says."""
    return bool(checkpoints_of(run))


def checkpoints_of(run: Path) -> list[Path]:
    """Checkpoints of a run, named by their updates, oldest first. Empty where it has none."""
    folder = run / CHECKPOINTS
    try:
        return sorted((path for path in folder.iterdir() if path.name.isdecimal()), key=lambda path: int(path.name))
    except (FileNotFoundError, NotADirectoryError):
        return []


def archive_stem(run_id: str, set_name: str, num_levels: int) -> str:
    """Name, without its ending, of an archive with some levels of a set."""
    return plain_name(f"{run_id}_{Path(set_name).stem}_{num_levels}_levels")


def file_names(names: Sequence[str]) -> list[str]:
    """Different names of level files in one directory for levels, of which two may have the same name."""
    found: list[str] = []
    for name in map(plain_name, names):
        own, number = name, 1
        while own in found:
            number += 1
            own = f"{name}_{number}"
        found.append(own)
    return [f"{name}.json" for name in found]


def plain_name(text: str) -> str:
    """Text as a file name: letters, digits, - and _; at most 100 of them."""
    return re.sub(r"[^\w-]+", "_", text, flags=re.ASCII).strip("_")[:100] or "levels"
