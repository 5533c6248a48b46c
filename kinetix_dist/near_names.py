"""Suggestions for misspelt names: "did you mean ..."."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str], or_else: str) -> str:
    """ "did you mean 'hop_home'?" where a known name is near, else the text `or_else`, which lists the names."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else or_else
