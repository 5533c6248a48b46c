"""JSON that every parser reads: `json.dumps` writes NaN and Infinity, which JSON does not have."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def json_text(
    content: Any, *, indent: int | None = None, sort_keys: bool = False, separators: tuple[str, str] | None = None
) -> str:
    """Return `content` as JSON text, with null for numbers that are not finite. The layout is that of `json.dumps`."""
    try:
        return json.dumps(content, indent=indent, sort_keys=sort_keys, separators=separators, allow_nan=False)
    except ValueError:
        finite = _finite(content)
    return json.dumps(finite, indent=indent, sort_keys=sort_keys, separators=separators, allow_nan=False)


def _finite(value: Any) -> Any:
    """Return the same plain values with None for numbers that are not finite."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {name: _finite(entry) for name, entry in value.items()}
    return [_finite(entry) for entry in value] if isinstance(value, list | tuple) else value
