"""Validation of level documents. Every complaint is one line: field, problem, remedy.

    problems = list(problems_of(document, capacity))      all complaints at once, for editors
    validate_document(document, capacity)                 raises the first of them

Two passes: structure by levels/schema.json (`structure.py`), then meaning (polygons convex and counter-clockwise,
references to shapes that exist, one green and one blue, ends of joints together, counts within the size). Entries of a
wrong structure are left out of the second pass.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.structure import (
    LevelFormatError,
    raise_first,
    read_document,
    size_problem,
    structure_problems,
    value_problems,
)
from kinetix_dist.level.walls import WALL_CENTRES_M, WALL_NAMES

__all__ = ["LevelFormatError", "RoleError", "check_polygon", "problems_of", "read_document", "validate_document"]

MIN_AREA_M2 = 1e-6  # a square of 1 mm
MAX_ANCHOR_GAP_M = 0.3  # ends of a joint farther apart are a mistake; people draw gaps of 0.15 m in the web editor
_PARTS = ("shapes", "joints", "thrusters")


class RoleError(LevelFormatError):
    """Another number of shapes than one has a role. Without any the level may be still drawn, which is no mistake."""

    def __init__(self, role: str, holders: list[str]) -> None:
        """holders: paths of the shapes and walls that have the role."""
        super().__init__("shapes", f"{len(holders)} shapes are {role}", f"make exactly one shape {role}")
        self.role, self.holders = role, holders


def validate_document(document: Any, capacity: Capacity, size_name: str | None = None) -> None:
    """Raises `LevelFormatError` for the first fault of a level of at most this capacity.

    size_name: the name of the capacity in messages.
    """
    raise_first(problems_of(document, capacity, size_name))


def problems_of(document: Any, capacity: Capacity, size_name: str | None = None) -> Iterator[LevelFormatError]:
    """Yield all faults of a level of at most this capacity. If the document is too large, that is the only one."""
    if (too_large := size_problem(document)) is not None:
        yield too_large
        return
    bad_paths = []
    for problem in _structure_of(document):
        bad_paths.append(problem.path)
        yield problem
    if not isinstance(document, dict) or not isinstance(document.get("shapes"), list):
        return
    good = {part: _good_items(document, part, bad_paths) for part in _PARTS}
    all_shapes_are_good = len(good["shapes"]) == len(document["shapes"])
    for i, shape in good["shapes"].items():
        if shape["type"] == "polygon":
            yield from _polygon_problems(shape["vertices"], f"shapes[{i}].vertices", capacity)
    yield from _name_problems(document["shapes"])
    names = [name for shape in document["shapes"] if isinstance(name := _name_of(shape), str)]
    shapes = {shape["id"]: shape for shape in good["shapes"].values()}
    for i, joint in good["joints"].items():
        yield from _joint_problems(joint, f"joints[{i}]", names, shapes)
    for i, thruster in good["thrusters"].items():
        yield from _reference_problems(thruster["shape"], f"thrusters[{i}].shape", names)
        if "anchor" in thruster and "position" in thruster:
            yield LevelFormatError(
                f"thrusters[{i}]",
                "has both 'anchor' (world) and 'position' (frame of the shape)",
                "keep one of the two",
            )
    if all_shapes_are_good and not any(path.startswith("walls") for path in bad_paths):
        yield from _role_problems(document)
    yield from _room_problems(document, capacity, size_name or str(capacity))


def _structure_of(document: Any) -> Iterator[LevelFormatError]:
    """Complain about numbers and texts first. NaN is a number to the schema, so that nothing is reported twice."""
    yield from value_problems(document)
    yield from structure_problems(document, levels_root() / "schema.json", see="docs/level_format.md")


def _good_items(document: dict[str, Any], part: str, bad_paths: list[str]) -> dict[int, dict[str, Any]]:
    """Shapes, joints or thrusters without complaints about their structure, by their indices."""
    items = document.get(part, [])
    if not isinstance(items, list):
        return {}
    bad = {path.removeprefix(f"{part}[").split("]")[0] for path in bad_paths if path.startswith(f"{part}[")}
    return {i: item for i, item in enumerate(items) if str(i) not in bad}


def check_polygon(vertices: list[list[float]], path: str, capacity: Capacity) -> None:
    """Raises `LevelFormatError` unless corners are few enough, convex, counter-clockwise and hold an area."""
    raise_first(_polygon_problems(vertices, path, capacity))


def _polygon_problems(vertices: list[list[float]], path: str, capacity: Capacity) -> Iterator[LevelFormatError]:
    """One complaint at most, but for repeated corners: one fault causes others."""
    count = len(vertices)
    if count > capacity.vertices:
        yield LevelFormatError(path, f"has {count} corners", f"use at most {capacity.vertices}")
        return
    turns, area, has_repeated = [], 0.0, False
    for i in range(count):
        before, here, after = vertices[i - 1], vertices[i], vertices[(i + 1) % count]
        edge_in = (here[0] - before[0], here[1] - before[1])
        edge_out = (after[0] - here[0], after[1] - here[1])
        if math.hypot(*edge_out) < 1e-9:
            has_repeated = True
            yield LevelFormatError(f"{path}[{i}]", "is the same point as the next corner", "remove one of the two")
        turns.append(edge_in[0] * edge_out[1] - edge_in[1] * edge_out[0])
        area += 0.5 * (here[0] * after[1] - here[1] * after[0])
    bad = [i for i, turn in enumerate(turns) if turn * area <= 0]
    if has_repeated:
        return
    if abs(area) < MIN_AREA_M2:
        yield LevelFormatError(path, f"polygon has an area of {abs(area):.1e} m^2", f"give at least {MIN_AREA_M2:.0e}")
    elif area < 0 and all(turn <= 0 for turn in turns):
        yield LevelFormatError(path, "corners run clockwise", "list them counter-clockwise (reverse the order)")
    elif bad:
        yield LevelFormatError(path, f"polygon is not convex at corner {bad[0]}", "split it, or move that corner out")


def _name_of(shape: Any) -> Any:
    return shape.get("id") if isinstance(shape, dict) else None


def _name_problems(shapes: list[Any]) -> Iterator[LevelFormatError]:
    seen = set()
    for i, name in enumerate(map(_name_of, shapes)):
        if not isinstance(name, str):
            continue
        if name in WALL_NAMES:
            yield LevelFormatError(f"shapes[{i}].id", f"{name!r} is the name of a wall", "give the shape another name")
        elif name in seen:
            yield LevelFormatError(f"shapes[{i}].id", f"{name!r} is used twice", "give each shape its own name")
        seen.add(name)


def _reference_problems(name: str, path: str, names: list[str]) -> Iterator[LevelFormatError]:
    if name not in names and name not in WALL_NAMES:
        yield LevelFormatError(path, f"there is no shape {name!r}", f"shapes are {', '.join([*names, *WALL_NAMES])}")


def _joint_problems(
    joint: dict[str, Any], path: str, names: list[str], shapes: dict[str, dict[str, Any]]
) -> Iterator[LevelFormatError]:
    for end in ("a", "b"):
        yield from _reference_problems(joint[end], f"{path}.{end}", names)
    if joint["a"] == joint["b"]:
        yield LevelFormatError(f"{path}.b", f"joins {joint['a']!r} to itself", "name another shape")
    given = tuple(name for name in ("anchor", "anchor_a", "anchor_b") if name in joint)
    if given not in (("anchor",), ("anchor_a", "anchor_b")):
        yield LevelFormatError(
            path,
            f"has {' and '.join(given) or 'no anchor'}",
            "give 'anchor' (world) or both 'anchor_a' and 'anchor_b' (frames of the shapes)",
        )
    limits = joint.get("limits")
    if limits is not None and limits[0] > limits[1]:
        yield LevelFormatError(f"{path}.limits", f"lower {limits[0]} is above upper {limits[1]}", "swap them")
    if limits is not None and joint["type"] == "fixed":
        yield LevelFormatError(f"{path}.limits", "a fixed joint has no limits", "remove them or use type 'revolute'")
    slides = joint["type"] == "prismatic"
    if slides and "axis" not in joint:
        yield LevelFormatError(f"{path}.axis", "is missing", "give the angle (rad, frame of a) along which b slides")
    elif not slides and "axis" in joint:
        yield LevelFormatError(
            f"{path}.axis", f"a {joint['type']} joint has no axis", "remove it or use type 'prismatic'"
        )
    elif given == ("anchor_a", "anchor_b"):
        yield from _gap_problems(joint, path, shapes)


def _gap_problems(joint: dict[str, Any], path: str, shapes: dict[str, dict[str, Any]]) -> Iterator[LevelFormatError]:
    """The two anchors of a joint must not be far apart; those of a slider may be, along its axis."""
    frame_a, frame_b = (_frame(joint[end], shapes) for end in ("a", "b"))
    if frame_a is None or frame_b is None:
        return  # a missing or faulty shape is reported already
    at_a, at_b = _in_world(frame_a, joint["anchor_a"]), _in_world(frame_b, joint["anchor_b"])
    gap = (at_b[0] - at_a[0], at_b[1] - at_a[1])
    axis = frame_a[2] + joint["axis"] if "axis" in joint else None
    apart = math.hypot(*gap) if axis is None else abs(math.cos(axis) * gap[1] - math.sin(axis) * gap[0])
    if apart > MAX_ANCHOR_GAP_M:
        across = "" if axis is None else " across its axis"
        yield LevelFormatError(
            path,
            f"its anchors are {apart:.3g} m apart{across}",
            f"move shapes or anchors to within {MAX_ANCHOR_GAP_M} m",
        )


def _frame(name: str, shapes: dict[str, dict[str, Any]]) -> tuple[float, float, float] | None:
    """x, y (m) and angle (rad) of the frame of a shape or wall; None of an unknown name."""
    if name in WALL_NAMES:
        x, y = WALL_CENTRES_M[WALL_NAMES.index(name)].tolist()
        return x, y, 0.0
    if name not in shapes:
        return None
    return (*shapes[name]["position"], shapes[name].get("angle", 0.0))


def _in_world(frame: tuple[float, float, float], point: list[float]) -> tuple[float, float]:
    x, y, angle = frame
    cos, sin = math.cos(angle), math.sin(angle)
    return x + cos * point[0] - sin * point[1], y + sin * point[0] + cos * point[1]


def _role_problems(document: dict[str, Any]) -> Iterator[LevelFormatError]:
    elements = {f"shapes[{i}]": shape for i, shape in enumerate(document["shapes"])}
    elements |= {f"walls.{name}": wall for name, wall in document.get("walls", {}).items()}
    for role in ("green", "blue"):
        holders = [path for path, element in elements.items() if element.get("role") == role]
        if len(holders) != 1:
            yield RoleError(role, holders)


def _room_problems(document: dict[str, Any], capacity: Capacity, size_name: str) -> Iterator[LevelFormatError]:
    kinds = Counter(str(shape.get("type")) for shape in document["shapes"] if isinstance(shape, dict))
    joints, thrusters = (document.get(part) for part in ("joints", "thrusters"))
    counts = (
        ("shapes", kinds["box"] + kinds["polygon"], capacity.polygons - NUM_WALLS, "boxes and polygons"),
        ("shapes", kinds["circle"], capacity.circles, "circles"),
        ("joints", len(joints) if isinstance(joints, list) else 0, capacity.joints, "joints"),
        ("thrusters", len(thrusters) if isinstance(thrusters, list) else 0, capacity.thrusters, "thrusters"),
    )
    for path, count, most, kind in counts:
        if count > most:
            yield LevelFormatError(
                path, f"{count} {kind}, size {size_name} has room for {most}", "use a larger size or remove some"
            )
