"""The designed sets and the files of their levels. Reads no level, so that it needs no jax."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kinetix_dist.level.paths import levels_root
from kinetix_dist.text_files import read_toml


def designed_sets() -> dict[str, dict[str, Any]]:
    """levels/sets.toml: for each set its description, size and level files (relative to levels/)."""
    return read_toml(levels_root() / "sets.toml")


def designed_names() -> list[str]:
    """Names of all designed levels, with and without their size: "s/hop_home", "hop_home"."""
    files = {file for entry in designed_sets().values() for file in entry["levels"]}
    paths = sorted(Path(file).with_suffix("") for file in files)
    return [*(path.as_posix() for path in paths), *(path.name for path in paths)]


def designed_files(name: str) -> list[Path]:
    """Files of the designed level "hop_home" or "s/hop_home": none, one, or one in each size that has the name."""
    if Path(name).is_absolute():  # not below the root, whatever it is joined to
        return []
    sizes = sorted({entry["size"] for entry in designed_sets().values()})
    found = [levels_root() / f"{folder}{name}.json" for folder in ("", *(f"{size}/" for size in sizes))]
    return [file for file in found if file.is_file() and file.parent != levels_root()]
