"""Text files that people wrote, with any byte order mark: one way to read all of them.

Editors of Windows begin UTF-8 with a mark or write UTF-16, which json and tomllib refuse. Copies from a Mac leave a
hidden file `._x.json` for each `x.json`, with attributes and no text: `is_hidden` finds these.
"""

from __future__ import annotations

import codecs
import json
import tomllib
from pathlib import Path
from typing import Any

from kinetix_dist.errors import UserError, one_line

_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def decode_text(content: bytes) -> str:
    """The text of UTF-8 with or without a byte order mark, or of UTF-16 with one. Raises UnicodeDecodeError."""
    return content.decode("utf-16" if content.startswith(_UTF16_MARKS) else "utf-8-sig")


def read_text(path: Path) -> str:
    """Raises OSError, and UnicodeDecodeError for what is no text."""
    return decode_text(path.read_bytes())


def read_json(path: Path) -> Any:
    """Raises OSError, and ValueError or RecursionError for what is no JSON."""
    return json.loads(read_text(path))


def read_json_object(path: Path, *, advice: str) -> dict[str, Any]:
    """Raises UserError, one line that ends with the advice, for what cannot be read or is no object."""
    try:
        content = read_json(path)
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read ({one_line(error)}); {advice}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path} holds no JSON object; {advice}")
    return content


def read_toml(path: Path) -> dict[str, Any]:
    """Raises OSError, and ValueError for what is no TOML."""
    return tomllib.loads(read_text(path))


def is_hidden(path: Path, directory: Path) -> bool:
    """True where a file below a directory is hidden, or lies in a hidden folder."""
    return any(part.startswith(".") for part in path.relative_to(directory).parts)
