"""Where the level data of this installation is."""

from __future__ import annotations

import os
from pathlib import Path

from kinetix_dist.installation import data_directory

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
