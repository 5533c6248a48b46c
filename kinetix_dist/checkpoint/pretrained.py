"""The policies that come with an installation, by name: `generalist` is pretrained/generalist of checkout or wheel."""

from __future__ import annotations

from pathlib import Path

from kinetix_dist.checkpoint.manifest import MANIFEST_NAME
from kinetix_dist.installation import data_directory


def pretrained_names() -> list[str]:
    """Names of the policies that are here."""
    return sorted(file.parent.name for file in data_directory("pretrained").glob(f"*/{MANIFEST_NAME}"))


def find_checkpoint(path: Path) -> Path:
    """`path` itself if there is such a directory, else the pretrained policy that it names; `path` if there is none."""
    if path.is_dir() or path.name != str(path) or path.name not in pretrained_names():
        return path
    return data_directory("pretrained") / path.name
