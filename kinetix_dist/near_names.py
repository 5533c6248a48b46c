"""Names that are near each other: suggestions for misspelt ones ("did you mean ..."), and names of one file."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str], or_else: str) -> str:
    """ "did you mean 'hop_home'?" if a known name is near, else the text `or_else`, which lists the names."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else or_else


def first_shared(names: Iterable[str]) -> tuple[str, str] | None:
    """Return the first two names of one file: equal, or equal but for case, which not all file systems tell apart."""
    seen: dict[str, str] = {}
    for name in names:
        if (key := name.casefold()) in seen:
            return seen[key], name
        seen[key] = name
    return None
