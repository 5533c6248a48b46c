"""The walls of a public level file: those of the usual box, or ones that are mended when a level is read.

Two kinds of files have other walls, and levels in them mean the usual box:
- the package up to version 0.1 put the left wall 5 cm too far left (an erratum that its README names), and levels that
  are copies of its files still have it there;
- the web editor writes walls of `collision_mode` 1. Walls of mode 2 differ from them for shapes of mode 0 alone, which
  would fall out of the box: a file with such a shape is refused.

The walls of the file are stored with the level (`PublicWalls`), so that exporting writes them again.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M
from kinetix_dist.level.structure import LevelFormatError
from kinetix_dist.level.walls import (
    COLLIDES_NORMALLY,
    COLLIDES_WITH_ALL,
    FLOOR_TOP_M,
    PASSES_THROUGH,
    WALL_NAMES,
)

Rows = dict[int, tuple[str, dict[str, Any]]]  # slot -> (path, row) of the active shapes of a file

_LEFT_WALL = WALL_NAMES.index("left_wall")
MISPLACED_LEFT_WALL_M = -0.05
_TOLERANCE_M = 1e-3
# Of each wall: the coordinate of the side that faces the box, and which of its corners' coordinates that is.
_FACES = ((1, max, FLOOR_TOP_M), (0, max, 0.0), (0, min, WORLD_SIZE_M), (1, min, WORLD_SIZE_M))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublicWalls:
    """Walls of a public file; the defaults are the usual box."""

    left_wall_x: float = 0.0  # m, of the side that faces the box
    collision_modes: tuple[int, ...] = (COLLIDES_WITH_ALL,) * NUM_WALLS  # in the order of WALL_NAMES

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> PublicWalls:
        """Walls of the field `public_walls` of a valid level document."""
        own: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
        return cls(**own)

    def to_json(self) -> dict[str, Any]:
        """Fields that differ from the usual box; empty for that box."""
        usual, found = dataclasses.asdict(USUAL_WALLS), dataclasses.asdict(self)
        return {name: list(v) if isinstance(v, tuple) else v for name, v in found.items() if v != usual[name]}

    @property
    def notes(self) -> list[str]:
        """Mended walls, a phrase each."""
        mended = []
        if self.left_wall_x != 0.0:
            off = f"{abs(self.left_wall_x) * 100:.3g} cm"
            mended.append(f"left wall {off} too far left (an erratum of the public package): moved to x = 0")
        softer = [name for name, mode in zip(WALL_NAMES, self.collision_modes) if mode != COLLIDES_WITH_ALL]
        if softer:
            mended.append(f"{', '.join(softer)} of collision_mode 1, as the web editor writes: read as 2")
        return mended


USUAL_WALLS = PublicWalls()


def read_walls(polygons: Rows) -> PublicWalls:
    """Walls of a file, its first four polygons. Raises `LevelFormatError` where they are not the usual box and cannot
    be mended without changing the level."""
    left_wall_x, modes = 0.0, []
    for slot in range(NUM_WALLS):
        path = f"env_state.polygon[{slot}]"
        remedy = f"levels here are played in a box of {WORLD_SIZE_M:g} x {WORLD_SIZE_M:g} m; restore that wall"
        if slot not in polygons:
            raise LevelFormatError(path, f"is not active, but is the {WALL_NAMES[slot]}", remedy)
        wall = polygons[slot][1]
        found, usual = _face_of(wall, slot), _FACES[slot][2]
        is_misplaced = slot == _LEFT_WALL and abs(found - MISPLACED_LEFT_WALL_M) <= _TOLERANCE_M
        is_in_place = is_misplaced or abs(found - usual) <= _TOLERANCE_M
        is_solid = wall["inverse_mass"] == 0 and wall["collision_mode"] in (COLLIDES_NORMALLY, COLLIDES_WITH_ALL)
        if not is_in_place or not is_solid:
            raise LevelFormatError(path, f"is not the {WALL_NAMES[slot]} of the usual box", remedy)
        if is_misplaced:
            left_wall_x = found
        modes.append(int(wall["collision_mode"]))
    return PublicWalls(left_wall_x=left_wall_x, collision_modes=tuple(modes))


def check_nothing_falls_out(shapes: Rows, walls: PublicWalls) -> None:
    """Raises `LevelFormatError` for a moving shape that a wall of the file lets through and one of ours would stop."""
    let_through = [slot for slot, mode in enumerate(walls.collision_modes) if mode != COLLIDES_WITH_ALL]
    for path, shape in shapes.values():
        if let_through and shape["collision_mode"] == PASSES_THROUGH and shape["inverse_mass"] != 0:
            raise LevelFormatError(
                f"{path}.collision_mode",
                f"is 0, which passes through the {WALL_NAMES[let_through[0]]}, whose collision_mode is 1",
                "walls here stop everything; give the shape 1, or the wall 2",
            )


def mended_wall(wall: dict[str, Any], slot: int, walls: PublicWalls) -> dict[str, Any]:
    """One of the first four polygons as the wall of the usual box; anchors in its frame stay where they are."""
    moved = _with_moved_face(wall, -walls.left_wall_x) if slot == _LEFT_WALL else wall
    return {**moved, "collision_mode": COLLIDES_WITH_ALL}


def wall_of_file(wall: dict[str, Any], slot: int, walls: PublicWalls) -> dict[str, Any]:
    """The wall that a file had, of one of the usual box. The inverse of `mended_wall`."""
    moved = _with_moved_face(wall, walls.left_wall_x) if slot == _LEFT_WALL else wall
    return {**moved, "collision_mode": walls.collision_modes[slot]}


def _with_moved_face(wall: dict[str, Any], shift: float) -> dict[str, Any]:
    """The left wall with the corners that face the box moved to the right by so many m."""
    face, cos, sin = _face_of(wall, _LEFT_WALL), math.cos(wall["rotation"]), math.sin(wall["rotation"])
    corners = {}
    for name, corner in wall["vertices"].items():
        is_face = abs(_in_world(wall, corner)[0] - face) <= _TOLERANCE_M
        moved = {"0": corner["0"] + cos * shift, "1": corner["1"] - sin * shift}  # the shift in the wall's own frame
        corners[name] = moved if is_face else corner
    return {**wall, "vertices": corners}


def _face_of(wall: dict[str, Any], slot: int) -> float:
    """Coordinate (m) of the side that faces the box."""
    axis, side, _ = _FACES[slot]
    corners = (wall["vertices"][str(corner)] for corner in range(wall["n_vertices"]))
    return side(_in_world(wall, corner)[axis] for corner in corners)


def _in_world(wall: dict[str, Any], corner: dict[str, float]) -> tuple[float, float]:
    cos, sin = math.cos(wall["rotation"]), math.sin(wall["rotation"])
    x, y = wall["position"]["0"], wall["position"]["1"]
    return x + cos * corner["0"] - sin * corner["1"], y + sin * corner["0"] + cos * corner["1"]
