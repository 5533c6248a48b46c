"""Checkpoints on disk: named arrays (Orbax), a description (JSON) and a SHA-256 manifest, published by one rename.

    checkpoints/00000040/            the number is that of policy updates done
        arrays/                      Orbax, one flat dictionary of arrays
        checkpoint.json              format, update, whatever the caller describes it by
        manifest.json                SHA-256 of every other file, written last

A checkpoint is written into a hidden directory of the same parent (a draft, `.saving-00000040-PID@HOST`), read back,
verified, and only then renamed; older ones are pruned after that. So a process that dies while saving leaves the
previous checkpoint as the newest, and a draft that the next run removes.

Policies that are bundled with an installation have names: `generalist` is pretrained/generalist of checkout or wheel.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import logging
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.atomic_directories import flush_directory, flush_tree, new_directory
from kinetix_dist.checkpoint.arrays import name_not_finite
from kinetix_dist.checkpoint.description import description_fault
from kinetix_dist.checkpoint.manifest import MANIFEST_NAME, manifest_fault, write_manifest
from kinetix_dist.errors import MAX_QUOTED, OneLineError, quoted, shortened
from kinetix_dist.installation import data_directory
from kinetix_dist.json_text import json_text
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.text_files import read_json

FORMAT = 1
DESCRIPTION_NAME = "checkpoint.json"
ARRAYS_NAME = "arrays"
_DIGITS = 8
_OVERHEAD_BYTES = 1 << 18  # of Orbax's database, description and manifest: 100 kB with 60 arrays


_PATTERN_CHARACTERS = frozenset("*?[]\\")


class CheckpointError(OneLineError):
    """A checkpoint that cannot be used, and why."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """One verified checkpoint in memory."""

    path: Path
    arrays: dict[str, np.ndarray]  # path through the saved pytree -> array
    description: dict[str, Any]  # of the form that description.py checks

    @property
    def config(self) -> dict[str, Any]:
        """Return the configuration that it was trained with, as it was stored. Raise CheckpointError for none."""
        if "config" not in self.description:
            raise CheckpointError(f"checkpoint {self.path} has no config of its training; give another checkpoint")
        return self.description["config"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rejected:
    """A checkpoint directory that was passed over, and why."""

    path: Path
    reason: str


def save_checkpoint(
    directory: Path, num_updates: int, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any], *, keep: int
) -> Path:
    """Writes, verifies and publishes one checkpoint, then prunes to the newest `keep` that verify; returns its path.

    Raises when it could not be made durable (OSError, CheckpointError, or what Orbax makes of a full disk); the older
    ones are then untouched.
    """
    if keep < 1:
        raise ValueError(f"keep is {keep}; at least 1 checkpoint must stay")
    if name := name_not_finite(arrays):
        raise CheckpointError(f"{name} is not finite: nothing could go on from it")
    directory.mkdir(parents=True, exist_ok=True)
    final = directory / f"{num_updates:0{_DIGITS}d}"
    draft = directory / f".saving-{final.name}-{os.getpid()}@{socket.gethostname()}"
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        _check_space(draft, arrays)
        _save_arrays(draft / ARRAYS_NAME, arrays)
        content = {"format": FORMAT, "num_updates": num_updates, "num_arrays": len(arrays), **description}
        (draft / DESCRIPTION_NAME).write_text(json_text(content, indent=1, sort_keys=True) + "\n")
        write_manifest(draft)
        flush_tree(draft)
        if fault := manifest_fault(draft):
            raise CheckpointError(f"checkpoint {final} could not be written: {fault}")
        shutil.rmtree(final, ignore_errors=True)
        os.replace(draft, final)
        flush_directory(directory)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise
    _prune(directory, keep, verified=final)
    return final


def save_alone(to: Path, num_updates: int, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> None:
    """Saves one checkpoint at `to` itself, which must not exist, to be archived or sent. Raises as `save_checkpoint`.

    Its files hold no path of this machine.
    """
    if to.exists():
        raise CheckpointError(f"{to} exists; choose another path")
    with new_directory(to) as draft:
        written = save_checkpoint(draft / "saved", num_updates, arrays, description, keep=1)
        for entry in sorted(written.iterdir()):
            entry.rename(draft / entry.name)
        shutil.rmtree(draft / "saved")
        # Orbax notes the absolute path it wrote to, which means nothing elsewhere.
        for note in draft.rglob("commit_success.txt"):
            note.write_text("Checkpoint commit was successful\n")
        write_manifest(draft)


def load_checkpoint(path: Path) -> Checkpoint:
    """Verifies a checkpoint directory against its manifest and reads it; raises CheckpointError otherwise.

    `path` may be the name of a pretrained policy that comes with the installation.
    """
    path = find_checkpoint(Path(path))
    if not path.is_dir():
        known = pretrained_names()
        hint = did_you_mean(str(path), known, f"pretrained policies here: {', '.join(known) or 'none'}")
        raise CheckpointError(f"there is no checkpoint {path}; {hint}")
    if fault := _fault(path):
        raise CheckpointError(f"checkpoint {path} {fault}")
    description, arrays = read_json(path / DESCRIPTION_NAME), _load_arrays(path / ARRAYS_NAME)
    if name := name_not_finite(arrays):
        shown = shortened(name, MAX_QUOTED)
        raise CheckpointError(f"checkpoint {path}: {shown} is not finite, so that no policy plays by it; give another")
    return Checkpoint(path=path, arrays=arrays, description=description)


def newest_good(directory: Path) -> tuple[Checkpoint | None, list[Rejected]]:
    """The newest checkpoint that verifies and reads, and those newer than it that were rejected."""
    rejected = []
    for path in reversed(list_checkpoints(directory)):
        try:
            return load_checkpoint(path), rejected
        except Exception as error:  # Orbax raises many classes for unreadable arrays: each means "walk back"
            rejected.append(Rejected(path=path, reason=" ".join(str(error).split()) or type(error).__name__))
    return None, rejected


def list_checkpoints(directory: Path) -> list[Path]:
    """Checkpoint directories, oldest first, whether good or not."""
    if not directory.is_dir():
        return []
    return sorted(path for path in directory.iterdir() if path.is_dir() and re.fullmatch(r"\d+", path.name))


def remove_dead_drafts(directory: Path) -> list[str]:
    """Removes drafts of processes that died while saving; returns their names. The caller holds the run's lock.

    A draft of a living process of this host stays. One of this process goes: in a container the next process often
    has the number of the one before it, and a run removes drafts before it saves anything. So does one of another host,
    whose process has lost the lock.
    """
    removed = []
    for path in sorted(directory.glob(".saving-*")) if directory.is_dir() else []:
        match = re.fullmatch(r"\.saving-\d+-(\d+)(?:@(.+))?", path.name)
        if match is None or not _is_alive_here(int(match[1]), match[2]):
            shutil.rmtree(path, ignore_errors=True)
            removed.append(path.name)
    return removed


def _is_alive_here(pid: int, host: str | None) -> bool:
    """True where another process of this host has this number. host None: a draft of an earlier version."""
    if pid == os.getpid() or host not in (None, socket.gethostname()):
        return False
    return Path(f"/proc/{pid}").exists()


def _prune(directory: Path, keep: int, *, verified: Path) -> None:
    """Removes what is older than the newest `keep` good checkpoints. A bad one does not count.

    verified: was found good just now, and is not read again.
    """
    num_good = 0
    for path in reversed(list_checkpoints(directory)):
        if num_good >= keep:
            shutil.rmtree(path, ignore_errors=True)
        elif path == verified or _fault(path) is None:
            num_good += 1


def _fault(path: Path) -> str | None:
    """Fault of a checkpoint on disk, in words; None for a good one. Arrays are compared by checksum."""
    try:
        if fault := manifest_fault(path):
            return f"is damaged: {fault}"
        description = read_json(path / DESCRIPTION_NAME)
    except (OSError, ValueError, RecursionError) as error:
        return f"cannot be read ({error})"
    if isinstance(description, dict) and (stored := description.get("format")) != FORMAT:
        return f"has format {quoted(stored)}; this version reads format {FORMAT}"
    if fault := description_fault(description):
        return f"cannot be read: {DESCRIPTION_NAME}: {fault}; give another checkpoint"
    return None


def _check_space(directory: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises OSError where the arrays cannot fit: Orbax's threads would write a traceback each to the console."""
    needed = sum(np.asarray(array).nbytes for array in arrays.values()) + _OVERHEAD_BYTES
    if (free := shutil.disk_usage(directory).free) < needed:
        raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)}: it needs {needed:,} bytes, {free:,} are free")


def _save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    import orbax.checkpoint as ocp

    empty = [name for name, array in arrays.items() if np.asarray(array).size == 0]
    if empty:
        raise ValueError(f"array {empty[0]} is empty; leave empty arrays out of a checkpoint")
    with _without_its_log(), _without_patterns(path) as plain:
        ocp.PyTreeCheckpointer().save(plain, dict(arrays))


@contextlib.contextmanager
def _without_patterns(path: Path) -> Generator[Path]:
    """The absolute `path`, by a link where directories above it have characters that Orbax takes for a pattern: it
    would write arrays there and not find them again."""
    folder = path.absolute().parent
    if not _PATTERN_CHARACTERS & set(str(folder)):
        yield path.absolute()
        return
    with tempfile.TemporaryDirectory(prefix="kinetix-dist-checkpoint-") as temporary:
        link = Path(temporary) / "link"
        link.symlink_to(folder, target_is_directory=True)
        yield link / path.name


@contextlib.contextmanager
def _without_its_log() -> Generator[None]:
    """Silences the log of Orbax, whose threads log with a traceback what it raises as well."""
    log = logging.getLogger("absl")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)


def _load_arrays(path: Path) -> dict[str, np.ndarray]:
    import orbax.checkpoint as ocp

    checkpointer = ocp.PyTreeCheckpointer()
    with _without_patterns(path) as plain:
        metadata = checkpointer.metadata(plain).item_metadata
        if metadata is None:
            raise CheckpointError(f"checkpoint {path.parent} has no metadata of its arrays")
        as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in metadata.tree}
        return dict(checkpointer.restore(plain, restore_args=as_numpy))


def pretrained_names() -> list[str]:
    """Names of the policies that are here."""
    return sorted(file.parent.name for file in data_directory("pretrained").glob(f"*/{MANIFEST_NAME}"))


def find_checkpoint(path: Path) -> Path:
    """`path` itself if there is such a directory, else the pretrained policy that it names; `path` if there is none."""
    if path.is_dir() or path.name != str(path) or path.name not in pretrained_names():
        return path
    return data_directory("pretrained") / path.name
