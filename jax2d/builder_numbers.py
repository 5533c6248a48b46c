"""Numbers that a builder is given, checked; and the errors it raises."""

from __future__ import annotations

import math
from collections.abc import Sequence

Point = Sequence[float]
LARGEST = 1e18  # any number given, masses and inertias and their inverses too: the square must fit float32


class SceneError(ValueError):
    """A scene that cannot be built; the message says what is wrong and what to do."""


class SceneFullError(SceneError):
    """The capacity has no slot left for what is added."""


def finite(name: str, values: Sequence[float], count: int) -> list[float]:
    """So many finite numbers; SceneError for any other."""
    try:
        numbers = [number(name, value) for value in values]
    except (TypeError, SceneError):
        numbers = []
    if len(numbers) != count:
        raise SceneError(f"{name} is {values!r}; give {count} finite numbers")
    return numbers


def number(name: str, value: float) -> float:
    try:
        given = math.nan if isinstance(value, (str, bytes, bool)) else float(value)
    except (TypeError, ValueError):
        given = math.nan
    if not abs(given) <= LARGEST:
        raise SceneError(f"{name} is {value!r}; give a finite number (of at most {LARGEST:g})")
    return given


def positive(name: str, value: float) -> float:
    given = number(name, value)
    if given <= 0:
        raise SceneError(f"{name} is {given:g}; it must be positive and finite")
    return given


def one_of(first: tuple[str, float | None], second: tuple[str, float | None]) -> None:
    """Raises SceneError where two ways to say the same are both used."""
    if first[1] is not None and second[1] is not None:
        raise SceneError(f"{first[0]} and {second[0]} are both given and say the same in other units; give one")
