"""Python processes that import what this one imports, whatever lies in the directory where they start.

    command_of("some.module") -> [python, -P, .../child_python.py, this process's sys.path, "some.module"]

`python -m MODULE` would put the current directory first: another checkout there, or a `jax.py`, would be run instead.
`-P` leaves it out, and the child takes the import path of this process before it imports anything. Every Python process
that the project starts is started by `command_of`; those of Ray get
`directories_outside_python` in another way (`ray_setup.py`).
Workers report the directories they import from (`imported_from`), and their starter compares these.
"""

from __future__ import annotations

import json
import runpy
import site
import sys
from pathlib import Path

_COMPARED = ("kinetix_dist", "jax2d", "jax", "numpy", "warp")  # packages that compute


def command_of(target: str, *arguments: object) -> list[str]:
    """Command line that runs a module by name, or a script by its path ending in .py, with the import path of this
    process."""
    path = json.dumps(import_path(), allow_nan=False)
    return [sys.executable, "-P", str(Path(__file__).resolve()), path, target, *map(str, arguments)]


def import_path() -> list[str]:
    """sys.path of this process with absolute directories, so that it means the same in another directory."""
    return [_absolute(entry) for entry in sys.path if entry or _has_current_directory()]


def directories_outside_python() -> list[str]:
    """Entries of `import_path` that belong to no installation of Python: checkouts, and directories of PYTHONPATH."""
    installed = [Path(prefix).resolve() for prefix in (sys.prefix, sys.base_prefix, *site.getsitepackages())]
    return [
        entry
        for entry in import_path()
        if not any(Path(entry).resolve().is_relative_to(prefix) for prefix in installed)
    ]


def _absolute(entry: str) -> str:
    """A directory; what setuptools puts there for an editable installation is no path and stays as it is."""
    return entry if entry.endswith(".__path_hook__") else str(Path(entry).absolute())


def _has_current_directory() -> bool:
    """False where the current directory was removed: nothing is imported from there."""
    try:
        Path.cwd()
    except FileNotFoundError:
        return False
    return True


def imported_from() -> dict[str, str]:
    """Directory of each package that computes and is imported in this process, by name."""
    found = {name: getattr(sys.modules.get(name), "__file__", None) for name in _COMPARED}
    return {name: str(Path(file).resolve().parent) for name, file in found.items() if file is not None}


def difference_of_imports(theirs: dict[str, str]) -> str:
    """Words for the packages that a child on this machine imports from elsewhere; empty: none. Packages that one of the
    two has not imported are not compared."""
    ours = imported_from()
    differ = [
        f"{name} from {theirs[name]} instead of {ours[name]}"
        for name in ours
        if theirs.get(name, ours[name]) != ours[name]
    ]
    return ", ".join(differ)


def _become(path: str, target: str, arguments: list[str]) -> None:
    sys.path[:] = json.loads(path)
    sys.argv[:] = [target, *arguments]
    if target.endswith(".py"):
        runpy.run_path(target, run_name="__main__")
    else:
        runpy.run_module(target, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _become(sys.argv[1], sys.argv[2], sys.argv[3:])
