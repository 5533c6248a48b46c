"""Whole numbers of an option, one by one or as ranges: "0..7", "0 3 5"."""

from __future__ import annotations

import re
from collections.abc import Sequence

MAX_COUNT = 10_000
MAX_SEEDS = 1000  # of an arm: every run of a plan is checked before the first one begins


def numbers_in(words: Sequence[str], option: str, *, most: int) -> list[int]:
    """Return the numbers of words, sorted: [0, 1, 2, 3] of "0..3", or of "0 1 2 3".

    Raises:
        ValueError: One line that names the option, for a word that gives no numbers up to `most`, for a number that
            is there twice, and for more than `MAX_COUNT` numbers.
    """
    found: set[int] = set()
    for word in words:
        match = re.fullmatch(r"([0-9]{1,10})(?:\.\.([0-9]{1,10}))?", word)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if not first <= last <= most or last - first >= MAX_COUNT:
            raise ValueError(f"{option} has {word!r}; give numbers such as 0..8 or 0 3 5, up to {most}")
        numbers = set(range(first, last + 1))
        if twice := found & numbers:
            raise ValueError(f"{option} has {min(twice)} twice; give each number once")
        found |= numbers
        if len(found) > MAX_COUNT:
            raise ValueError(f"{option} has more than {MAX_COUNT:,} numbers; give fewer")
    if not found:
        raise ValueError(f"{option} is empty; give numbers such as 0..8 or 0 3 5")
    return sorted(found)
