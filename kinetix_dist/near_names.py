"""Names that are nearly right: what says "did you mean" in this package."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str], otherwise: str) -> str:
    """ "did you mean 'hop_home'?" where a known name is near, else the text `otherwise`, which says what there is."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else otherwise
