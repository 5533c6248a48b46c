"""Configurations as plain values: dataclasses to and from the types of JSON and TOML, fields by dotted name."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from typing import Any

from kinetix_dist.errors import MAX_QUOTED, quoted, shortened
from kinetix_dist.json_text import json_text
from kinetix_dist.setting import ConfigError


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON types."""
    return json.loads(json_text(dataclasses.asdict(config)))


def build(kind: Any, data: Any, where: str = "") -> Any:
    """Return the value of a field of type `kind`, such as a config dataclass, from types of JSON or TOML.

    Args:
        where: Name of the field, for complaints.

    Raises:
        ConfigError: A field is unknown, missing, of another type or outside its limits.
    """
    if dataclasses.is_dataclass(kind):
        if not isinstance(data, Mapping):
            raise ConfigError(f"config field {where or 'top level'} is {quoted(data)}; an object is needed")
        hints = typing.get_type_hints(kind)
        names = {field.name for field in dataclasses.fields(kind)}
        if unknown := sorted(set(data) - names):
            raise ConfigError(
                f"config field {shortened(_join(where, unknown[0]), MAX_QUOTED)} is unknown; fields are "
                f"{', '.join(sorted(names))}"
            )
        needed = [
            field.name
            for field in dataclasses.fields(kind)
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        ]
        if missing := [name for name in needed if name not in data]:
            raise ConfigError(f"config field {_join(where, missing[0])} is missing")
        fields = {name: build(hints[name], value, _join(where, name)) for name, value in data.items()}
        try:
            return kind(**fields)
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(str(error)) from error
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        if not isinstance(data, list | tuple):
            raise ConfigError(f"config field {where} is {quoted(data)}; a list is needed")
        inner = arguments[0] if len(arguments) == 2 and arguments[1] is Ellipsis else Any
        return tuple(build(inner, value, where) for value in data)
    if origin in (typing.Union, types.UnionType):
        if data is None:
            return None
        return build(next(option for option in arguments if option is not types.NoneType), data, where)
    if origin is dict and not isinstance(data, Mapping):
        raise ConfigError(f"config field {where} is {quoted(data)}; an object is needed")
    if kind is float and isinstance(data, int) and not isinstance(data, bool):
        return float(data)
    if kind in (int, float, str, bool) and type(data) is not kind:
        raise ConfigError(f"config field {where} is {quoted(data)}; {kind.__name__} is needed")
    return data


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def flat(data: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Fields of nested sections by their full names: {"ppo.epochs": 8, ...}."""
    fields = {}
    for name, value in data.items():
        fields |= flat(value, _join(where, name)) if isinstance(value, Mapping) else {_join(where, name): value}
    return fields


def differing(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> list[str]:
    """Fields of nested dictionaries of plain values that differ, as "ppo.epochs 8 instead of 4"."""
    left, right = flat(ours), flat(theirs)
    return in_words({name: (left.get(name), right.get(name)) for name in left | right})


def in_words(values: Mapping[str, tuple[Any, Any]]) -> list[str]:
    return [f"{name} {left!r} instead of {right!r}" for name, (left, right) in sorted(values.items()) if left != right]
