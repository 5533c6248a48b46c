"""Counts that callers give: anything but a whole number is refused in one line."""

from __future__ import annotations

import operator
from typing import Any


def whole_number(name: str, value: Any) -> int:
    """`value` as an int. Raises ValueError for anything else, True and False too."""
    try:
        if not isinstance(value, bool):
            return operator.index(value)
    except TypeError:
        pass
    raise ValueError(f"{name} is {value!r}; it must be a whole number")
