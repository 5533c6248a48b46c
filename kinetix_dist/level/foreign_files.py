"""Level sets of the public package's ecosystem that are no JSON: recognised, named, and never loaded.

The package's own editor saves a level as `.json` or, under any other name, as a pickle (`.pcg.pkl`), and its training
saves buffers of levels as pickles. Loading a pickle runs the code in it: nothing here does.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

REMEDY = "write each level as JSON, in the public package with `export_env_state_to_json`"
_KINDS = {
    b"\x80": "a Python pickle, which is never loaded because that would run the code in it",
    b"BZh": "a bzip2 archive, as which the public package saves pickles, which are never loaded",
    b"\x1f\x8b": "a gzip archive",
    b"PK": "a zip archive, as NumPy's .npz is",
    b"\x93NUMPY": "a NumPy array",
    b"\x89HDF": "an HDF5 file",
}  # by their first bytes, none of which begins a JSON text
_ZARR_FILES = (".zgroup", ".zarray", ".zmetadata", "zarr.json")
_SUFFIXES = (".pkl", ".pickle", ".pbz2", ".npz", ".npy", ".zarr", ".h5", ".hdf5", ".zip", ".gz", ".msgpack")


def kind_of_bytes(content: bytes) -> str | None:
    """What a file is that begins with these bytes, where it is a known archive; None of what may be text."""
    return next((kind for begins, kind in _KINDS.items() if content.startswith(begins)), None)


def is_zarr_store(directory: Path) -> bool:
    """Whether a directory is a store of arrays, whose JSON files are no levels."""
    return any((directory / name).is_file() for name in _ZARR_FILES)


def foreign_files(directory: Path) -> str:
    """What a directory without levels holds instead, to end a complaint with; empty where nothing is known."""
    found = Counter(path.suffix for path in directory.rglob("*") if path.suffix in _SUFFIXES)
    counts = ", ".join(f"{count} {suffix}" for suffix, count in sorted(found.items()))
    return f"; {counts} cannot be read here: {REMEDY}" if found else ""
