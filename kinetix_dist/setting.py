"""Declaration of settings: a field's default and limits, stated once, beside the field.

    num_envs: int = setting(2048, minimum=1)  # worlds, over all devices

`check_settings(self)`, called by `__post_init__` of a config dataclass, holds every field to its type and limits. The
comment beside a field is its help (`kinetix-dist train --help`).
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from kinetix_dist.errors import OneLineError, quoted

T = TypeVar("T")
_KEY = "limits"
# Limits of networks. A stranger's config may name any number, and tracing 256 layers takes 12 s already.
MAX_WIDTH = 65_536
MAX_LAYERS = 256


class ConfigError(OneLineError, ValueError):
    """A configuration that cannot run, with the field and the value."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits:
    """Values that a setting may have."""

    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    below: float | None = None
    choices: Iterable[str] | None = None  # names; a registry is looked up at each check, since plugins add to it

    def allow(self, value: Any) -> bool:
        if self.choices is not None:
            return value in self.choices
        return (
            (self.minimum is None or value >= self.minimum)
            and (self.maximum is None or value <= self.maximum)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def __str__(self) -> str:
        """Remedy: "it must be 1 or more"."""
        if self.choices is not None:
            return f"choose one of {', '.join(self.choices)}"
        if self.minimum is not None and self.maximum is not None:
            return f"it must be from {self.minimum} to {self.maximum}"
        parts = [(self.above, "above {}"), (self.minimum, "{} or more"), (self.maximum, "{} or less")]
        parts += [(self.below, "below {}")]
        return "it must be " + " and ".join(text.format(limit) for limit, text in parts if limit is not None)


def setting(
    default: T,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    below: float | None = None,
    choices: Iterable[str] | None = None,
) -> T:
    """Field of a config dataclass with a default and limits."""
    limits = Limits(minimum=minimum, maximum=maximum, above=above, below=below, choices=choices)
    return dataclasses.field(default=default, metadata={_KEY: limits})


def check_settings(section: Any) -> None:
    """Raises ConfigError for the first field that is not of its type, not finite or outside its limits."""
    for field in dataclasses.fields(section):
        name, value = f"{type(section).__name__}.{field.name}", getattr(section, field.name)
        _check_type(name, value, str(field.type))
        check_finite(value, name)
        limits: Limits | None = field.metadata.get(_KEY)
        if limits is not None and not limits.allow(value):
            raise ConfigError(f"{name} is {quoted(value)}; {limits}")


def check_finite(section: Any, field: str = "") -> None:
    """Raise ConfigError for a number of a dataclass, or of anything in it, that is not finite.

    NaN passes a limit that is written as `value < 0`, so options and settings come through here first.
    """
    if section is None or isinstance(section, str | int):  # most fields; whole numbers may be beyond float
        return
    if isinstance(section, numbers.Real) and not math.isfinite(section):
        raise ConfigError(f"{field} is {section}; it must be a finite number")
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(section, tuple | list):
        items = enumerate(section)
    elif isinstance(section, Mapping):
        items = section.items()
    elif dataclasses.is_dataclass(section):
        items = [(each.name, getattr(section, each.name)) for each in dataclasses.fields(section)]
    for name, item in items:
        check_finite(item, f"{field}.{name}".removeprefix("."))


def _check_type(name: str, value: Any, kind: str) -> None:
    """kind: the annotation as it is written; other types than int, float and bool are not looked at."""
    if kind == "int":
        from jax2d.whole_numbers import whole_number  # loads JAX, which readers of run directories do without

        try:
            whole_number(name, value)
        except ValueError as error:
            raise ConfigError(str(error)) from None
    if kind == "float":
        if not isinstance(value, numbers.Real) or isinstance(value, bool):
            raise ConfigError(f"{name} is {quoted(value)}; it must be a number")
    if kind == "bool" and not isinstance(value, bool):
        raise ConfigError(f"{name} is {quoted(value)}; it must be True or False")
