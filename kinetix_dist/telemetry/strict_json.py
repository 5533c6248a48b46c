"""JSON as RFC 8259 has it: for files that another process, version or editor may have written.

Python's reader takes NaN and Infinity, and makes infinity of 1e999. JSON has no such numbers: a page could not be sent
what was read, and columns of numbers would hold what no run has measured. Integers have 64 bits here, as columns of
them do. Our own writers write null for a value that is not finite.
"""

from __future__ import annotations

import json
import math
from typing import Any

MAX_INTEGER = 2**63 - 1


def loads(content: bytes | str) -> Any:
    """Raises ValueError, in one line: no JSON, or which number is none."""
    try:
        found = json.loads(content)
        bad = _bad_number(found)
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None
    except ValueError as error:
        raise ValueError(" ".join(str(error).split())) from None
    if bad is not None:
        names, problem = bad
        raise ValueError(" ".join(filter(None, [".".join(reversed(names)), problem])))
    return found


def _bad_number(value: Any) -> tuple[list[str], str] | None:
    """(names that lead to it, the innermost first; what is wrong) of the first number that JSON does not have."""
    if isinstance(value, float):
        return None if math.isfinite(value) else ([], f"is {value}, which JSON does not have")
    if isinstance(value, int):
        return None if -MAX_INTEGER <= value <= MAX_INTEGER else ([], "is an integer of more than 64 bits")
    if isinstance(value, dict):
        entries = value.items()
    elif isinstance(value, list):
        entries = enumerate(value)
    else:
        return None
    for name, entry in entries:
        bad = _bad_number(entry)
        if bad is not None:
            bad[0].append(str(name))
            return bad
    return None
