"""Files about the curriculum for dashboards, `curriculum/` of a run; docs/run_data.md describes every field.

    refresh_XXXXXXXX.npz   levels that a refresh stored, counts of all candidates
    buffer_XXXXXXXX.npz    a replay buffer at a checkpoint
    outcomes.jsonl         attempts of training, by level of the buffer and by where levels come from

Written by `runtime/driver/run_data.py`, read by dashboards. Needs numpy alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.setting import check_settings, setting
from kinetix_dist.telemetry.json_lines import read_lines

FORMAT = 1  # of snapshots
OUTCOMES_FORMAT = 2  # lines count attempts, the first episode of each world in an update
DIRECTORY = "curriculum"
OUTCOMES = "outcomes.jsonl"
REFRESH, BUFFER = "refresh", "buffer"
KINDS = (REFRESH, BUFFER)
LEVELS = "levels/"  # what arrays of levels are below
_NAME = re.compile(rf"({'|'.join(KINDS)})_(\d{{8}})\.npz")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CurriculumLogConfig:
    """Amount of the curriculum that is written down. Changes no number of training."""

    outcomes_every: int = setting(16, minimum=0)  # updates that a line of outcomes.jsonl covers at most; 0: no lines
    probe_levels: int = setting(256, minimum=0)  # of the outgoing buffer, played again by the next refresh; 0: none
    probe_every: int = setting(1, minimum=1)  # refreshes from one that plays such levels to the next
    max_snapshots: int = setting(64, minimum=0)  # files of a kind that keep their levels; 0: no file is written

    def __post_init__(self) -> None:
        check_settings(self)
        if self.max_snapshots == 1:
            raise ValueError(
                "CurriculumLogConfig.max_snapshots is 1; the first and the newest stay: give 2 or more, or 0"
            )

    def has_probe(self, refresh: int) -> bool:
        """True where a refresh plays levels of the buffer in use again; the first, number 0, has none."""
        return self.probe_levels > 0 and refresh > 0 and refresh % self.probe_every == 0


class SnapshotError(ValueError):
    """A file that is no snapshot, or one of another format, or damaged; which, in one line."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Snapshot:
    """One .npz file as it was read."""

    kind: str  # of KINDS
    number: int  # of the file's name: policy version, or updates done
    arrays: Mapping[str, np.ndarray]  # by the names of docs/run_data.md, without those of levels
    levels: Mapping[str, np.ndarray] | None  # [n, ...] by path; None: left out, or not requested
    has_levels: bool  # the file has them


def snapshot_name(kind: str, number: int) -> str:
    """refresh_00000128.npz"""
    return f"{kind}_{number:08d}.npz"


def list_snapshots(directory: Path) -> list[tuple[str, int, Path]]:
    """(kind, number, path) of the snapshots in a run's `curriculum/`, oldest first. Empty where there is none."""
    if not directory.is_dir():
        return []
    named = ((_NAME.fullmatch(path.name), path) for path in directory.iterdir())
    found = [(match[1], int(match[2]), path) for match, path in named if match]
    return sorted(found, key=lambda entry: (entry[1], entry[0]))


def read_snapshot(path: Path, *, with_levels: bool = True) -> Snapshot:
    """Raises SnapshotError, and OSError where the file cannot be opened."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        raise SnapshotError(f"{path} is no snapshot of a curriculum; their names are refresh_XXXXXXXX.npz")
    try:
        with np.load(path, allow_pickle=False) as file:
            names = [name for name in file.files if with_levels or not name.startswith(LEVELS)]
            content = {name: file[name] for name in names}
            has_levels = any(name.startswith(LEVELS) for name in file.files)
    # RuntimeError: a flipped bit that calls an entry encrypted, or compressed in a way that there is not.
    except (ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise SnapshotError(f"{path} is damaged: {' '.join(str(error).split())}") from None
    if "format" not in content or int(content["format"]) != FORMAT:
        found = content.get("format", "none")
        raise SnapshotError(f"{path} has format {found}; this version reads format {FORMAT}")
    levels = {name.removeprefix(LEVELS): array for name, array in content.items() if name.startswith(LEVELS)}
    return Snapshot(
        kind=match[1],
        number=int(match[2]),
        arrays={name: array for name, array in content.items() if not name.startswith(LEVELS)},
        levels=levels if levels else None,
        has_levels=has_levels,
    )


def write_snapshot(directory: Path, kind: str, number: int, arrays: Mapping[str, Any]) -> Path:
    """Writes a snapshot by a rename. Raises OSError, and leaves nothing behind then."""
    directory.mkdir(exist_ok=True)
    path = directory / snapshot_name(kind, number)
    content = io.BytesIO()
    np.savez_compressed(content, format=np.int32(FORMAT), kind=np.str_(kind), **arrays)
    replace_file(path, content.getvalue())
    return path


def thin_snapshots(directory: Path, kind: str, max_snapshots: int) -> list[Path]:
    """Leaves levels in `max_snapshots` files of a kind at most; returns those that lost theirs. Raises OSError.

    They stay in the newest file, and in the first and every 2^s-th one after it, with the lowest s that is enough: what
    has lost them would not keep them later either. So two files keep theirs in any case. Raises SnapshotError.
    """
    paths = [path for found, _, path in list_snapshots(directory) if found == kind]
    stride = 1
    while len(keeps := {*range(0, len(paths), stride), len(paths) - 1}) > max(max_snapshots, 2):
        stride *= 2
    thinned = []
    for place, path in enumerate(paths):
        if place in keeps or not _has_levels(path):
            continue
        snapshot = read_snapshot(path, with_levels=False)
        arrays = {name: array for name, array in snapshot.arrays.items() if name not in ("format", "kind")}
        thinned.append(write_snapshot(directory, kind, snapshot.number, arrays))
    return thinned


def _has_levels(path: Path) -> bool:
    """True for a file with levels; False for one that cannot be read, too: its reader says so."""
    try:
        with zipfile.ZipFile(path) as file:
            return any(name.startswith(LEVELS) for name in file.namelist())
    except (zipfile.BadZipFile, OSError):
        return False


def remove_later_snapshots(directory: Path, num_updates: int, *, is_curated: bool = False) -> list[Path]:
    """Removes the files that a run which goes on after so many updates is about to write again; returns damaged ones.

    A buffer is written with the checkpoint of its update, a refresh is adopted after it, or before it: is_curated.
    """
    damaged = []
    for kind, _, path in list_snapshots(directory):
        try:
            written_after = int(read_snapshot(path, with_levels=False).arrays["written_after"])
        except (SnapshotError, KeyError):
            damaged.append(path)
            continue
        if written_after > num_updates or (kind == REFRESH and written_after == num_updates and not is_curated):
            path.unlink()
    return damaged


def level_ids(levels: Mapping[str, np.ndarray]) -> np.ndarray:
    """[n] uint64: BLAKE2b over the bytes of a level's arrays [n, ...], in the order of their names."""
    arrays = [np.ascontiguousarray(levels[name]) for name in sorted(levels)]
    flat = [array.reshape(len(array), int(np.prod(array.shape[1:]))) for array in arrays]
    rows = np.concatenate([array.view(np.uint8) for array in flat], axis=1)
    digests = (hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows)
    return np.frombuffer(b"".join(digests), "<u8").astype(np.uint64)


def read_outcomes(path: Path) -> list[dict[str, Any]]:
    """Lines of an outcomes.jsonl; damaged and unfinished ones are left out. An absent file has none."""
    return read_lines(path, is_outcomes).rows


def is_outcomes(row: Mapping[str, Any]) -> bool:
    """True for an object that is a line of outcomes.jsonl of this format."""
    return (
        row.get("format") == OUTCOMES_FORMAT
        and isinstance(row.get("update"), int)
        and isinstance(row.get("sources"), dict)
    )
