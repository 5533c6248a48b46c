"""Checks of the scene builder's arguments: numbers and polygons that make no world are refused in one line."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from jax2d.settings import Settings
from jax2d.shapes import polygon_integrals
from jax2d.xla.vec2 import cross

Point = Sequence[float] | np.ndarray  # (x, y)
Points = Sequence[Point] | np.ndarray  # (x, y) of each
SMALLEST_AREA_M2 = 1e-8  # a square of 0.1 mm: below it inverse inertia overflows float32 when squared
SMALLEST_RADIUS_M = math.sqrt(SMALLEST_AREA_M2 / math.pi)
SAME_POINT = 1e-6  # of the longest edge: shorter ones have no direction
LARGEST = 1e18  # any number given, masses and inertias and their inverses too: the square must fit float32


class SceneError(ValueError):
    """A scene that cannot be built; the message says what is wrong and what to do."""


class SceneFullError(SceneError):
    """The capacity has no slot left for what is added."""


def finite(name: str, values: Point, count: int) -> list[float]:
    try:
        checked = [number(name, value) for value in values]
    except (TypeError, SceneError):
        checked = []
    if len(checked) != count:
        raise SceneError(f"{name} is {values!r}; give {count} finite numbers")
    return checked


def number(name: str, value: float) -> float:
    try:
        given = math.nan if isinstance(value, (str, bytes, bool)) else float(value)
    except (TypeError, ValueError):
        given = math.nan
    except OverflowError:  # an int with more digits than a message should have
        given = value = math.inf if value > 0 else -math.inf
    if not abs(given) <= LARGEST:
        raise SceneError(f"{name} is {value!r}; give a finite number (of at most {LARGEST:g})")
    return given


def direction(name: str, value: float) -> float:
    """Return a finite angle (rad), reduced."""
    return reduced(number(name, value))


def reduced(angle: float) -> float:
    """Return the same direction (rad) within half a turn of 0. An angle of at most one turn stays, bit for bit.

    Call it before an angle becomes float32, in which 1e5 turns are up to 1.8 degrees off.
    """
    return math.remainder(angle, math.tau) if abs(angle) > math.tau else angle


def positive(name: str, value: float) -> float:
    checked = number(name, value)
    if checked <= 0:
        raise SceneError(f"{name} is {checked:g}; it must be positive and finite")
    return checked


def not_negative(name: str, value: float) -> float:
    checked = number(name, value)
    if checked < 0:
        raise SceneError(f"{name} is {checked:g}; it must be 0 or more")
    return checked


def flag(name: str, value: bool | np.bool_) -> bool:
    if not isinstance(value, (bool, np.bool_)):
        raise SceneError(f"{name} is {value!r}; it must be True or False")
    return bool(value)


def in_units(name: str, value: float, settings: Settings, unit: str) -> float:
    """A number as scenes hold it, as a multiple of the setting `unit`."""
    size = getattr(settings, unit)
    if not abs(value) <= LARGEST * size or size == 0:
        raise SceneError(f"{name} is {value:g}, but scenes hold it in units of Settings.{unit}, {size:g}; raise that")
    return value / size


def one_of(first: tuple[str, float | None], second: tuple[str, float | None]) -> None:
    """Raises SceneError where two ways to say the same are both used."""
    if first[1] is not None and second[1] is not None:
        raise SceneError(f"{first[0]} and {second[0]} are both given and say the same in other units; give one")


def check_polygon(vertices: Points, max_vertices: int) -> np.ndarray:
    """[k, 2] float64 vertices of a valid convex counter-clockwise polygon; SceneError names what is wrong."""
    try:
        corners = np.asarray(vertices, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise SceneError("vertices are no list of (x, y) points; give numbers in metres, two for each") from None
    if corners.ndim != 2 or corners.shape[1] != 2:
        raise SceneError(f"vertices have shape {corners.shape}; give a list of (x, y) points")
    if not (np.abs(corners) <= LARGEST).all():
        raise SceneError(f"vertices hold NaN or more than {LARGEST:g}; give finite coordinates in metres")
    if not 3 <= len(corners) <= max_vertices:
        raise SceneError(
            f"{len(corners)} vertices; this capacity takes 3 to {max_vertices}, so split the shape or raise "
            "Capacity.vertices"
        )
    edges = np.roll(corners, -1, 0) - corners
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    for i, length in enumerate(lengths):
        if length <= SAME_POINT * max(lengths.max(), 1e-30):
            raise SceneError(f"vertices {i} and {(i + 1) % len(corners)} are the same point; drop one of them")
    area, _, _ = polygon_integrals(corners)
    turns = cross(edges, np.roll(edges, -1, 0)) / (lengths * np.roll(lengths, -1))
    if abs(area) < SMALLEST_AREA_M2:
        raise SceneError(f"the polygon has an area of {area:g} m^2; it needs at least {SMALLEST_AREA_M2:g}")
    if area < 0 and (turns <= 1e-9).all():
        raise SceneError("vertices run clockwise; list them counter-clockwise (reverse the list)")
    if (turns < -1e-6).any() or area < 0 or _winding(edges) != 1:
        bad = int(np.argmin(turns)) + 1
        raise SceneError(
            f"the polygon is not convex at vertex {bad % len(corners)}; split it into convex parts and weld them"
        )
    return corners


def _winding(edges: np.ndarray) -> int:
    """Number of turns of the outline: 1 for a simple convex polygon, 2 for a pentagram."""
    headings = np.arctan2(edges[:, 1], edges[:, 0])
    turns = (np.diff(np.append(headings, headings[0])) + math.pi) % (2 * math.pi) - math.pi
    return round(float(turns.sum()) / (2 * math.pi))
