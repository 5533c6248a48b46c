"""Files of trajectories: .npz to keep them, .png and .gif to look at them."""

from __future__ import annotations

import dataclasses
import os
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from jax2d.contact_report import ContactReport
from jax2d.draw import draw as draw_world
from jax2d.fields import as_dict, from_dict
from jax2d.images import write_gif, write_png
from jax2d.rasteriser import Box, check_view
from jax2d.scene import Scene

if TYPE_CHECKING:
    from jax2d.trajectory import Trajectory

FORMAT = "jax2d trajectory 1"
MARGIN = 0.1  # of the view, around what moves
WIDTH_PX = 640
FRAMES_PER_SECOND = 25.0


def save(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """See `Trajectory.save`."""
    path = _with_ending(path, (".npz",))
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


def load(kind: type[Trajectory], path: str | os.PathLike[str]) -> Trajectory:
    """See `Trajectory.load`."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if str(arrays.pop("format")) != FORMAT:
            raise ValueError
        return _from_arrays(kind, arrays)
    except (ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile):
        raise ValueError(f"{os.fspath(path)} is no file that Trajectory.save wrote ({FORMAT!r})") from None


def _from_arrays(kind: type[Trajectory], arrays: dict[str, np.ndarray]) -> Trajectory:
    """Raises KeyError or TypeError where some are missing or too many."""
    parts: dict[str, dict[str, np.ndarray]] = {"scene": {}, "contacts": {}}
    values: dict[str, Any] = {}
    for name, x in arrays.items():
        part, _, rest = name.partition(".")
        (parts[part] if rest else values)[rest or part] = x
    values["interval"] = float(values["interval"])
    contacts = ContactReport(**parts["contacts"]) if parts["contacts"] else None
    return kind(scene=from_dict(Scene, parts["scene"]), contacts=contacts, **values)


def draw(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    *,
    view: Box | None = None,
    width: int = WIDTH_PX,
    roles: Any = None,
    frames_per_second: float = FRAMES_PER_SECOND,
    speed: float = 1.0,
) -> None:
    """See `Trajectory.draw`."""
    path = _with_ending(path, (".png", ".gif"))
    if trajectory.position.ndim != 3:
        raise ValueError(f"{trajectory.position.shape[1]} worlds; draw one of them: trajectory.world(0).draw(...)")
    for name, value in (("width", width), ("frames_per_second", frames_per_second), ("speed", speed)):
        if not value > 0:
            raise ValueError(f"{name} is {value}; give more than 0")
    if view is not None:
        check_view(view)
    box = view if view is not None else view_of(trajectory)

    def picture(sample: int, trails: Any = ()) -> np.ndarray:
        state = SimpleNamespace(position=trajectory.position[sample], angle=trajectory.angle[sample])
        thrust = None if trajectory.thruster is None else trajectory.thruster[sample]
        scale = width / (box[2] - box[0])
        return draw_world(
            trajectory.scene, state, roles, thrust=thrust, view=box, pixels_per_metre=scale, trails=trails
        )

    if path.suffix == ".png":
        write_png(path, picture(-1, list(np.moveaxis(trajectory.position[:, trajectory.is_movable], 1, 0))))
        return
    seconds = trajectory.time[-1] / speed
    frames = max(1, round(seconds * frames_per_second))
    samples = np.minimum(np.arange(frames) * speed / frames_per_second / trajectory.interval, trajectory.num_intervals)
    write_gif(path, [picture(round(k)) for k in samples], seconds=[1 / frames_per_second] * frames)


def view_of(trajectory: Trajectory) -> Box:
    """The part of the world in which something moves, with a margin; of a world where nothing can, of its shapes."""
    shapes = trajectory.scene.shapes
    shown = trajectory.is_movable if trajectory.is_movable.any() else np.asarray(shapes.active)
    reach = np.concatenate([np.linalg.norm(shapes.vertices, axis=-1).max(-1, initial=0), np.asarray(shapes.radius)])
    positions, reach = trajectory.position[:, shown], reach[shown, None]
    fine = np.where(np.isfinite(positions), positions, np.nanmin(positions))
    low, high = (fine - reach).min((0, 1)), (fine + reach).max((0, 1))
    margin = MARGIN * (high - low).max()
    return tuple(float(x) for x in (*(low - margin), *(high + margin)))  # type: ignore[return-value]


def _with_ending(path: str | os.PathLike[str], endings: tuple[str, ...]) -> Path:
    path = Path(path)
    if path.suffix not in endings:
        raise ValueError(f"{path.name!r} has another ending than {' or '.join(endings)}, which says what is written")
    return path
