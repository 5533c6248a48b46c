"""Names for interchangeable parts: observations, action spaces, rewards, networks, curricula. Built-in ones are
registered in the package that defines them, those of a user by a module that `run.plugins` names
(docs/extending.md)."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

from kinetix_dist.near_names import did_you_mean

T = TypeVar("T")


class PluginError(ValueError):
    """A module of `run.plugins` that cannot be imported, with what to do."""


class Registry(Generic[T]):
    """Parts of one kind by name. A name stands for one part: it is never replaced."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._parts: dict[str, T] = {}

    def register(self, name: str, part: T) -> T:
        """Adds a part and returns it. Raises ValueError where the name is taken."""
        if name in self._parts:
            raise ValueError(f"there is a {self._kind} {name!r} already; register yours under another name")
        self._parts[name] = part
        return part

    def __getitem__(self, name: str) -> T:
        """The part of that name; raises ValueError with the names there are."""
        if name not in self._parts:
            hint = did_you_mean(name, self._parts, f"choose one of {', '.join(self._parts)}")
            raise ValueError(f"unknown {self._kind} {name!r}; {hint}")
        return self._parts[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __contains__(self, name: object) -> bool:
        return name in self._parts


def import_plugins(modules: Iterable[str]) -> None:
    """Imports modules that register parts. Every process of a run does so before it builds anything."""
    for module in modules:
        try:
            importlib.import_module(module)
        except (Exception, SystemExit) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise PluginError(
                f"run.plugins: module {module!r} cannot be imported ({reason}); install it on every machine of the "
                "run, or put its directory on PYTHONPATH"
            ) from error
