"""Names of files in addresses of pages.

A file name may hold anything but NUL and /: bytes that are not UTF-8, which no script can encode, `%`, which is decoded
once more by some reader, quotes, line breaks.
"""

from __future__ import annotations

import os

_ESCAPED = '%~,"\\'  # `,` separates names in queries


def address_name(name: str) -> str:
    """Return the name of a file as addresses spell it: printable, and a different one for each file.

    Bytes that would be misread become `~` and two hexadecimal digits: "100%" is "100~25".
    """
    return "".join(char if _is_plain(char) else _escaped(char) for char in name)


def _is_plain(char: str) -> bool:
    return char.isprintable() and char not in _ESCAPED


def _escaped(char: str) -> str:
    return "".join(f"~{byte:02x}" for byte in os.fsencode(char))
