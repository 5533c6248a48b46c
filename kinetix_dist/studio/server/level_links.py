"""Levels in links: behind the # of any address of the editor, so that every installation opens them.

    http://127.0.0.1:8650/#/edit?level=1.eJx...    version, then the level's JSON, deflated with a checksum, base64url
    http://127.0.0.1:8650/#/edit?level=q1Yq...     links from before there were versions: deflated without a checksum

The pages write and read the same (static/editor/links.js). Host, port and token have no meaning for the level.
"""

from __future__ import annotations

import base64
import binascii
import re
import zlib
from typing import Any

from kinetix_dist.errors import UserError
from kinetix_dist.text_files import loads_json

LINK_VERSION = 1
MAX_LEVEL_BYTES = 3_000_000  # a few bytes of a link can be many
_LINK = re.compile(r"(?:^|[#?&])level=([^&#\s]*)")
_ADDRESS = re.compile(r"https?://|#/")
_PACKED = re.compile(r"(?:(\d{1,9})\.)?([\w-]+)", re.ASCII)
_WITHOUT_HEADER = -zlib.MAX_WBITS


def linked_level(text: str) -> str | None:
    """The level's part of a link, of what is behind its #, or of `level=...`; "" of an address without a level, which
    `read_link` refuses. None: the text is no link."""
    found = _LINK.search(text.strip())
    if found:
        return found[1]
    return "" if _ADDRESS.match(text.strip()) else None


def read_link(packed: str) -> dict[str, Any]:
    """The document of a level's part of a link. Raises UserError for a damaged link and for another version."""
    found = _PACKED.fullmatch(packed)
    if found is None:
        raise UserError("this link is damaged: it holds no level; copy all of it again, in quotes")
    if found[1] is not None and int(found[1]) != LINK_VERSION:
        raise UserError(
            f"this link is of version {found[1]}, this installation reads version {LINK_VERSION}; "
            "open it with a newer kinetix-dist"
        )
    try:
        document = loads_json(_inflated(found[2], _WITHOUT_HEADER if found[1] is None else zlib.MAX_WBITS))
    except (ValueError, binascii.Error, zlib.error) as error:
        raise UserError("this link is damaged or cut off; copy all of it again, in quotes") from error
    if not isinstance(document, dict):
        raise UserError("this link holds no level: its content is no JSON object")
    return document


def _inflated(text: str, window_bits: int) -> bytes:
    stream = zlib.decompressobj(window_bits)
    content = stream.decompress(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)), MAX_LEVEL_BYTES)
    if stream.unconsumed_tail:
        raise UserError(f"the level of this link is too large; a level has at most {MAX_LEVEL_BYTES / 1e6:g} MB")
    if not stream.eof:
        raise ValueError("the end is missing")
    return content
