"""Level files of the directory (or the one file) that a person named on the command line: listed, read, saved.

A file is identified by the SHA-256 of its bytes. A save names the hash that the file had when it was read: a file that
changed since stays as it is, also if two pages or two servers save at once. Saving is atomic and follows links.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
from pathlib import Path

from kinetix_dist.atomic_files import compare_and_replace
from kinetix_dist.level.structure import MAX_LEVEL_BYTES
from kinetix_dist.text_files import FileTooLargeError, decode_text, read_bytes

SUFFIX = ".json"
MAX_LISTED = 2000


class FileNameError(ValueError):
    """The name is not that of a level file of the directory, or the file is not one."""


class ConflictError(Exception):
    """The file changed since it was read. `hash` is the current one, or None if the file is gone."""

    def __init__(self, text: str, hash: str | None) -> None:
        super().__init__(text)
        self.hash = hash


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelFile:
    """Level file as it was read."""

    name: str  # relative to the directory, with /
    text: str
    hash: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelFiles:
    """Level files of a directory and of folders in it. `only` names a single file to list, read and save."""

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
        """Read a file. Raises FileNameError (also if it is not UTF-8), FileNotFoundError, OSError."""
        path = self._path(name)
        try:
            content = read_bytes(path, MAX_LEVEL_BYTES)
            text = decode_text(content)
        except FileTooLargeError as error:
            raise FileNameError(f"{name}: {error}; a level file has a few kB") from error
        except UnicodeDecodeError as error:
            raise FileNameError(f"{name} is no text ({error.reason} at byte {error.start})") from error
        return LevelFile(name=name, text=text, hash=hash_of(content))

    def save(self, name: str, text: str, *, was: str | None) -> str:
        """Save a text and return the hash of the file.

        Args:
            was: the hash that the file must have before, or None if there must be no file.

        Raises:
            FileNameError, ConflictError: nothing was saved.
            OSError: the disk is full, or the file is read-only; it is as before.
        """
        path = self._path(name)
        content = text.encode("utf-8")
        if len(content) > MAX_LEVEL_BYTES:
            raise FileNameError(f"{name} would have more than {MAX_LEVEL_BYTES >> 20} MiB")

        def refuse_other(before: bytes | None) -> None:
            current = None if before is None else hash_of(before)
            if current != was:
                change = "is gone" if current is None else "was changed elsewhere" if was else "is there already"
                raise ConflictError(f"{name} {change}; nothing was saved", current)

        compare_and_replace(path, content, refuse_other)
        return hash_of(content)

    def _path(self, name: str) -> Path:
        if not self._is_name(name):
            raise FileNameError(f"{name!r} is no level file that can be named here; give a name that ends in {SUFFIX}")
        if self.only is not None and name != self.only:
            raise FileNameError(f"{name} is not the file that was named on the command line, {self.only}")
        path = self.directory / name
        # A link that a person named may lead anywhere; another one in a directory may not.
        if self.only is None and not path.resolve().is_relative_to(self.directory.resolve()):
            raise FileNameError(f"{name} leads out of the directory")
        if path.exists() and not path.is_file():  # reading a pipe would wait for ever
            raise FileNameError(f"{name} is not a regular file")
        if not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, "its folder is missing", name)
        return path

    def _is_name(self, name: str) -> bool:
        """True for FILE.json or FOLDER/FILE.json, nothing hidden, and no path elsewhere."""
        parts = name.split("/")
        plain = all(part and not part.startswith(".") and part.isprintable() and "\\" not in part for part in parts)
        return plain and len(parts) <= 2 and name.endswith(SUFFIX) and len(name) <= 200


def hash_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
