"""SHA-256 of every file of a checkpoint: a flipped byte is found before its numbers are used.

Array files restore a flipped byte as a silently wrong number, so a checkpoint is only as good as its manifest.
The manifest is written last; a directory without one was never finished.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from kinetix_dist.errors import printable, shortened
from kinetix_dist.json_text import json_text
from kinetix_dist.text_files import read_json

MANIFEST_NAME = "manifest.json"
_CHUNK_BYTES = 1 << 20


def write_manifest(directory: Path) -> None:
    """Writes `manifest.json`: relative path -> {"sha256", "bytes"} of every other file below `directory`."""
    files = {
        str(path.relative_to(directory)): {"sha256": _sha256(path), "bytes": path.stat().st_size}
        for path in _files(directory)
    }
    (directory / MANIFEST_NAME).write_text(json_text({"files": files}, indent=1, sort_keys=True) + "\n")


def manifest_fault(directory: Path) -> str | None:
    """Fault of the files of a checkpoint, in words; None when every file is as it was written."""
    try:
        files = read_json(directory / MANIFEST_NAME)["files"]
        listed = {name: (expected["bytes"], expected["sha256"]) for name, expected in files.items()}
    except FileNotFoundError:
        return f"it has no {MANIFEST_NAME}: it was never finished"
    except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
        return f"its {MANIFEST_NAME} cannot be read ({error})"
    if not listed:
        return f"its {MANIFEST_NAME} lists no files"
    present = {str(path.relative_to(directory)) for path in _files(directory)}
    for name, (num_bytes, sha256) in listed.items():
        if name not in present:  # nor is a file outside of the directory
            return f"file {shortened(printable(name), 200)} is missing"
        path = directory / name
        if path.stat().st_size != num_bytes:
            return f"file {name} has {path.stat().st_size} bytes instead of {num_bytes}"
        if _sha256(path) != sha256:
            return f"file {name} does not have the SHA-256 that was written"
    return None


def _files(directory: Path) -> list[Path]:
    return sorted(path for path in directory.rglob("*") if path.is_file() and path.name != MANIFEST_NAME)


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()
