"""Files of trajectories: .npz, to the last bit."""

from __future__ import annotations

import dataclasses
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jax2d.contact_report import ContactReport
from jax2d.fields import as_dict, from_dict
from jax2d.scene import Scene

FORMAT = "jax2d trajectory 1"
T = TypeVar("T")


def save(trajectory: Any, path: str | os.PathLike[str]) -> None:
    """See `Trajectory.save`."""
    path = with_ending(path, (".npz",))
    arrays: dict[str, Any] = {"format": np.array(FORMAT)}
    for field in dataclasses.fields(trajectory):
        value = getattr(trajectory, field.name)
        if isinstance(value, Scene):
            arrays |= {f"scene.{name}": x for name, x in as_dict(value).items()}
        elif isinstance(value, ContactReport):
            arrays |= {f"contacts.{part.name}": getattr(value, part.name) for part in dataclasses.fields(value)}
        elif value is not None:
            arrays[field.name] = value
    np.savez_compressed(path, **arrays)


def load(kind: Callable[..., T], path: str | os.PathLike[str]) -> T:
    """See `Trajectory.load`."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if str(arrays.pop("format")) != FORMAT:
            raise ValueError
        return _from_arrays(kind, arrays)
    except (ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile):
        raise ValueError(f"{os.fspath(path)} is no file that Trajectory.save wrote ({FORMAT!r})") from None


def _from_arrays(kind: Callable[..., T], arrays: dict[str, np.ndarray]) -> T:
    """Raises KeyError or TypeError where some are missing or too many."""
    parts: dict[str, dict[str, np.ndarray]] = {"scene": {}, "contacts": {}}
    values: dict[str, Any] = {}
    for name, x in arrays.items():
        part, _, rest = name.partition(".")
        (parts[part] if rest else values)[rest or part] = x
    values["interval"] = float(values["interval"])
    contacts = ContactReport(**parts["contacts"]) if parts["contacts"] else None
    return kind(scene=from_dict(Scene, parts["scene"]), contacts=contacts, **values)


def with_ending(path: str | os.PathLike[str], endings: tuple[str, ...]) -> Path:
    """Path with one of these endings; ValueError for any other."""
    path = Path(path)
    if path.suffix not in endings:
        raise ValueError(f"{path.name!r} has another ending than {' or '.join(endings)}, which says what is written")
    return path
