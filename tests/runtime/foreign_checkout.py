"""A directory in which `python -m` would import other code than the tests do."""

from __future__ import annotations

from pathlib import Path

HIDDEN = ("kinetix_dist", "jax2d")  # packages that another checkout has


def foreign_checkout(folder: Path) -> Path:
    """`folder` with packages and a jax.py that end a program which imports them with status 7."""
    for name in HIDDEN:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text("raise SystemExit(7)")
    (folder / "jax.py").write_text("raise SystemExit(7)")
    return folder
