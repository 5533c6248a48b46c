"""Installation of this package: its data files, and its engine, whose import name `jax2d` a published package has too.

In a checkout levels and pretrained policies stand at its top, `levels/` and `pretrained/`; a wheel has them inside the
package, in `data/` (pyproject.toml says which).

An environment with both packages called `jax2d` imports one of them, or has files of both in one directory. `guard`
makes that one line: an ImportError where `jax2d` would be another package than the engine of this installation, a
warning where it would not but the other one is installed too.
"""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

PACKAGE = Path(__file__).resolve().parent


def data_directory(name: str) -> Path:
    """The directory `name` of the wheel, or else of the checkout; it may be missing where neither is whole."""
    installed = PACKAGE / "data" / name
    return installed if installed.is_dir() else PACKAGE.parent / name


NOT_INSTALLED = "not installed"


def version_of(package: str = "kinetix-dist") -> str:
    """Version of an installed package; NOT_INSTALLED of one that is not, as this one where a checkout is run."""
    from importlib.metadata import PackageNotFoundError, version  # 20 ms that an import of the package does not need

    try:
        return version(package)
    except PackageNotFoundError:
        return NOT_INSTALLED


NAME = "jax2d"
ENGINE = Path(__file__).absolute().parent.parent / NAME  # next to this package; either may be a link
_REMEDY = f"uninstall that one (`pip uninstall {NAME}`), or give kinetix-dist an environment of its own"


class EngineImportError(ImportError):
    """`jax2d` would be another package than the engine."""


@functools.cache
def engine_complaint() -> str:
    """One line that says which package stands in for the engine, and what to do; empty: none does."""
    directory = _imported_directory()
    if directory is not None and directory != ENGINE.resolve():
        return (
            f"the package {NAME} at {directory} is imported instead of the engine of kinetix-dist at {ENGINE}, which "
            f"has the same name; {_REMEDY}, or take its directory off PYTHONPATH"
        )
    published = _published()
    if published is not None and published[1] == ENGINE.parent.resolve():
        return (
            f"files of the published package {NAME} {published[0]} lie among those of the engine at {ENGINE}, which "
            f"has the same name; uninstall both (`pip uninstall {NAME} kinetix-dist`) and install kinetix-dist again"
        )
    return ""


@functools.cache
def engine_note() -> str:
    """One line where the published package is installed too, and the engine is imported; empty: it is not."""
    published = _published()
    if published is None or engine_complaint():
        return ""
    return (
        f"the published package {NAME} {published[0]} is installed at {published[1]} too; {NAME} is the engine of "
        f"kinetix-dist at {ENGINE} here, and the other one elsewhere: {_REMEDY}"
    )


def guard() -> None:
    """Makes `import jax2d` raise EngineImportError where it would give another package. Warns of both."""
    if engine_complaint():
        sys.meta_path.insert(0, _Refusing())
    elif note := engine_note():
        warnings.warn_explicit(note, UserWarning, "kinetix_dist", 1)  # no file: it stays one line


class _Refusing(MetaPathFinder):
    """Finds nothing; raises for the engine and its modules."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname == NAME or fullname.startswith(f"{NAME}."):
            raise EngineImportError(engine_complaint(), name=NAME)
        return None


def _imported_directory() -> Path | None:
    """Directory that `import jax2d` takes; None where there is none."""
    module = sys.modules.get(NAME)
    file = getattr(module, "__file__", None)
    if module is None:
        spec = PathFinder.find_spec(NAME)
        file = None if spec is None else spec.origin
    return None if file is None else Path(file).resolve().parent


def _published() -> tuple[str, Path] | None:
    """(version, directory of packages) of the published package by its metadata; None where it is not installed."""
    for entry in filter(os.path.isabs, sys.path):  # packages are not installed in the current directory
        for name in os.listdir(entry) if os.path.isdir(entry) and os.access(entry, os.R_OK) else []:
            if name.startswith(f"{NAME}-") and name.endswith((".dist-info", ".egg-info")):
                return name.removeprefix(f"{NAME}-").rsplit(".", 1)[0], Path(entry).resolve()
    return None
