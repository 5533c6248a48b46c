"""Level files of the directory (or the one file) that a person named on the command line: listed, read, saved.

A file is known by the SHA-256 of its bytes. Saving names the hash that the file had when it was read: a file that
changed since is left as it is. Saving is atomic: the file is new as a whole, or as before.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import tempfile
from pathlib import Path

from kinetix_dist.text_files import decode_text

SUFFIX = ".json"
MAX_FILE_BYTES = 4 << 20  # of a level file; the largest public one has 60 kB
MAX_LISTED = 2000


class FileNameError(ValueError):
    """Name of no level file of the directory."""


class ConflictError(Exception):
    """The file changed since it was read. `found`: its hash now; None: it is gone."""

    def __init__(self, text: str, found: str | None) -> None:
        super().__init__(text)
        self.found = found


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelFile:
    """Level file as it was read."""

    name: str  # relative to the directory, with /
    text: str
    hash: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelFiles:
    """Level files of a directory and of folders in it; `only`: the one that is listed, read and saved, None: all."""

    directory: Path
    only: str | None = None

    def names(self) -> list[str]:
        """Sorted names of existing level files, at most MAX_LISTED."""
        if self.only is not None:
            return [self.only] if (self.directory / self.only).is_file() else []
        found = [*self.directory.glob(f"*{SUFFIX}"), *self.directory.glob(f"*/*{SUFFIX}")]
        names = (path.relative_to(self.directory).as_posix() for path in found if path.is_file())
        return sorted(name for name in names if self._is_name(name))[:MAX_LISTED]

    def read(self, name: str) -> LevelFile:
        """Reads a file. Raises FileNameError (also for what is no UTF-8), FileNotFoundError, OSError."""
        path = self._path(name)
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
        if len(content) > MAX_FILE_BYTES:
            raise FileNameError(f"{name} has more than {MAX_FILE_BYTES >> 20} MiB; a level file has a few kB")
        try:
            text = decode_text(content)
        except UnicodeDecodeError as error:
            raise FileNameError(f"{name} is no text ({error.reason} at byte {error.start})") from error
        return LevelFile(name=name, text=text, hash=hash_of(content))

    def save(self, name: str, text: str, *, was: str | None) -> str:
        """Saves a text and returns the hash of the file. was: the hash that it must have before; None: it must be new.

        Raises FileNameError, ConflictError, OSError (a full disk: the file is as before).
        """
        path = self._path(name)
        content = text.encode("utf-8")
        if len(content) > MAX_FILE_BYTES:
            raise FileNameError(f"{name} would have more than {MAX_FILE_BYTES >> 20} MiB")
        found = hash_of(path.read_bytes()) if path.is_file() else None
        if found != was:
            what = "is gone" if found is None else "was changed elsewhere" if was else "is there already"
            raise ConflictError(f"{name} {what}; nothing was saved", found)
        _replace(path, content)
        return hash_of(content)

    def _path(self, name: str) -> Path:
        if not self._is_name(name):
            raise FileNameError(f"{name!r} is no level file that can be named here; give a name that ends in {SUFFIX}")
        if self.only is not None and name != self.only:
            raise FileNameError(f"{name} is not the file that was named on the command line, {self.only}")
        path = self.directory / name
        if not path.resolve().is_relative_to(self.directory.resolve()):
            raise FileNameError(f"{name} leads out of the directory")
        return path

    def _is_name(self, name: str) -> bool:
        """True for FILE.json or FOLDER/FILE.json, nothing hidden, and no path elsewhere."""
        parts = name.split("/")
        plain = all(part and not part.startswith(".") and part.isprintable() and "\\" not in part for part in parts)
        return plain and len(parts) <= 2 and name.endswith(SUFFIX) and len(name) <= 200


def hash_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _replace(path: Path, content: bytes) -> None:
    """Replaces a file atomically; it keeps its permissions."""
    number, draft = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    try:
        with open(number, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(draft, path.stat().st_mode & 0o777 if path.is_file() else 0o644)
        os.replace(draft, path)
    except BaseException:
        with contextlib.suppress(OSError):  # the first error is the one to report
            os.unlink(draft)
        raise
