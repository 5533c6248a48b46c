"""Data files of this installation: levels and pretrained policies.

In a checkout they stand at its top, `levels/` and `pretrained/`; a wheel has them inside the package, in `data/`
(pyproject.toml says which).
"""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


def data_directory(name: str) -> Path:
    """The directory `name` of the wheel, or else of the checkout; it may be missing where neither is whole."""
    installed = PACKAGE / "data" / name
    return installed if installed.is_dir() else PACKAGE.parent / name
