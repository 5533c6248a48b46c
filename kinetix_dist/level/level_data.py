"""The level data of this installation: its directory, the designed sets and files, and names of variants.

Reads no level, so that it needs no jax.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.installation import data_directory
from kinetix_dist.text_files import read_toml


def designed_sets() -> dict[str, dict[str, Any]]:
    """levels/sets.toml: for each set its description, size and level files (relative to levels/). One that is made of
    other sets has their files."""
    sets = read_toml(levels_root() / "sets.toml")
    for entry in sets.values():
        if "sets" in entry:
            entry["levels"] = [file for name in entry["sets"] for file in sets[name]["levels"]]
    return sets


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


LEVELS_VARIABLE = "KINETIX_DIST_LEVELS"


def levels_root() -> Path:
    """The directory with sets.toml, schema.json and the designed levels: `$KINETIX_DIST_LEVELS` if set, else that of
    this installation. Raises FileNotFoundError where it holds no levels."""
    named = os.environ.get(LEVELS_VARIABLE)
    root = Path(named) if named else data_directory("levels")
    if not (root / "schema.json").is_file():
        raise FileNotFoundError(
            f"no level data at {root} (schema.json is missing); set {LEVELS_VARIABLE} to the levels/ directory of a "
            "checkout of the repository"
        )
    return root


# Sets of variants -> the designed set whose levels they are variants of
VARIED_SETS = {f"dev_designed_{size}": f"all_designed_{size}" for size in ("s", "m", "l")}


def variant_name(level: str, number: int) -> str:
    """The name of a variant of a level."""
    return f"{level}_{number}"


def base_levels(name: str, names: Sequence[str]) -> list[str]:
    """Base levels of the levels of set `name`, by their names: the one that each is a variant of, or itself.

    Variants of one level are solved or not together: they are one observation of levels like these.
    """
    return [each.rpartition("_")[0] for each in names] if name in VARIED_SETS else list(names)
