"""Names for interchangeable parts: observations, action spaces, rewards, networks, curricula. Built-in ones are
registered in the package that defines them, parts of a user by a module that `run.plugins` names
(docs/extending.md)."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Generic, TypeVar

from kinetix_dist.near_names import did_you_mean

T = TypeVar("T")
TRUST_PLUGINS = "--trust-plugins"  # option of every command
TRUST_VARIABLE = "KINETIX_DIST_TRUST_PLUGINS"  # environment variable that passes the option on to child processes


class PluginError(ValueError):
    """A module of `run.plugins` that cannot be imported, with what to do."""


class Registry(Generic[T]):
    """Parts of one kind by name. A part is never replaced."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._parts: dict[str, T] = {}

    def register(self, name: str, part: T) -> T:
        """Adds a part and returns it. Raises ValueError if the name is taken."""
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


def import_stored_plugins(modules: Sequence[str]) -> tuple[str, ...]:
    """Return the plugins that a file from outside names, imported if the user trusts them.

    A module that this process has imported already needs no trust: the user chose it, and naming it runs no code.

    Raises:
        PluginError: A module is not imported, and the user has not given `--trust-plugins`.
    """
    missing = [name for name in modules if name not in sys.modules]
    if missing and os.environ.get(TRUST_VARIABLE) != "1":
        names = ", ".join(repr(name[:60]) for name in missing[:5])
        raise PluginError(
            f"it names plugins, modules whose code would run: {names}; give {TRUST_PLUGINS} if you trust them (in "
            "Python: import them first)"
        )
    import_plugins(missing)
    return tuple(modules)
