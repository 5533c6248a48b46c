"""Text files from outside: one reader for their bytes, their encoding and their JSON.

    read_json(path)         the JSON of a file
    loads_json(content)     the JSON of a request, a link, or a line

Editors of Windows begin UTF-8 with a byte order mark or write UTF-16, which json and tomllib refuse. Copies from a Mac
leave a hidden file `._x.json` for each `x.json`, with attributes and no text: `is_hidden` finds these.

JSON is strict. Python's `json` reads NaN and Infinity, makes infinity of 1e999, and takes the last of two equal keys.
JSON has no such numbers: a page could not receive them, and columns of numbers would hold values that no run measured.
Of two equal keys another reader may take the first. Integers have 64 bits, as in columns. Brackets nest MAX_DEPTH deep,
so that recursive readers need no check of their own.
"""

from __future__ import annotations

import codecs
import json
import math
import tomllib
from pathlib import Path
from typing import Any

from kinetix_dist.errors import UserError, one_line, printable, shortened

_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
MAX_FILE_BYTES = 64 << 20
MAX_INTEGER = 2**63 - 1
MAX_DEPTH = 100  # brackets within brackets
_SHOWN = 80  # characters of a key in a message


class FileTooLargeError(ValueError):
    """The file has more bytes than its reader takes."""


def read_bytes(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a file. Raises OSError and FileTooLargeError."""
    with path.open("rb") as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise FileTooLargeError(f"it has more than {max_bytes >> 20} MiB")
    return content


def decode_text(content: bytes) -> str:
    """Return the text of UTF-8 with or without a byte order mark, or of UTF-16 with one. Raises UnicodeDecodeError."""
    return content.decode("utf-16" if content.startswith(_UTF16_MARKS) else "utf-8-sig")


def read_text(path: Path) -> str:
    """Return the text of a file. Raises OSError, UnicodeDecodeError and FileTooLargeError."""
    return decode_text(read_bytes(path))


def loads_json(content: bytes | str) -> Any:
    """Return the content of strict JSON.

    Raises:
        ValueError: one line with the place and the fault.
    """
    try:
        text = decode_text(content) if isinstance(content, bytes) else content
        parsed = json.loads(text, object_pairs_hook=_object)
        fault = _fault(parsed, MAX_DEPTH)
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None
    except ValueError as error:  # also text that is not UTF-8, and whole numbers of 4,300 digits
        raise ValueError(one_line(error)) from None
    if fault is not None:
        names, problem = fault
        place = "".join(reversed(names)).removeprefix(".")
        raise ValueError(f"{shortened(place, _SHOWN)} {problem}".lstrip())
    return parsed


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"an object has the key {_quoted(twice)} twice")
    return entries


def _quoted(name: str) -> str:
    return shortened(repr(name), _SHOWN)


def _fault(value: Any, depth: int) -> tuple[list[str], str] | None:
    """Return (".name" or "[index]" that lead to it, the innermost first; the problem) of the first faulty number.

    Raises RecursionError if brackets nest deeper than `depth`.
    """
    if isinstance(value, float):
        return None if math.isfinite(value) else ([], f"is {value}, which JSON does not have")
    if isinstance(value, int):
        return None if -MAX_INTEGER <= value <= MAX_INTEGER else ([], "is an integer of more than 64 bits")
    if isinstance(value, dict):
        entries = value.items()
    elif isinstance(value, list):
        if value and set(map(type, value)) == {int} and min(value) >= -MAX_INTEGER and max(value) <= MAX_INTEGER:
            return None  # counts of levels: a line may have thousands
        entries = enumerate(value)
    else:
        return None
    if not depth:
        raise RecursionError
    for name, entry in entries:
        fault = _fault(entry, depth - 1)
        if fault is not None:
            fault[0].append(f"[{name}]" if isinstance(name, int) else f".{printable(name)}")
            return fault
    return None


def read_json(path: Path, *, max_bytes: int = MAX_FILE_BYTES) -> Any:
    """Return the content of a file of strict JSON. Raises OSError, and ValueError as `loads_json` does."""
    return loads_json(read_bytes(path, max_bytes))


def read_json_object(path: Path, *, advice: str) -> dict[str, Any]:
    """Return the JSON object of a file. Raises UserError, one line that ends with the advice."""
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read ({one_line(error)}); {advice}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path} holds no JSON object; {advice}")
    return content


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises OSError, and ValueError for other content."""
    return tomllib.loads(read_text(path))


def is_hidden(path: Path, directory: Path) -> bool:
    """Return True if a file below a directory is hidden, or is in a hidden folder."""
    return any(part.startswith(".") for part in path.relative_to(directory).parts)
