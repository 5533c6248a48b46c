"""Is a level document well formed? Every complaint is one line: which field, what is wrong, what to do.

Two passes: structure by levels/schema.json (fields, types, ranges), then meaning (polygons convex and
counter-clockwise, references to shapes that exist, one green and one blue, room in the size).
"""

from __future__ import annotations

import functools
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS
from kinetix_dist.level.paths import levels_root
from kinetix_dist.level.walls import WALL_NAMES

MIN_AREA_M2 = 1e-6  # a square of 1 mm
MAX_NUMBER = 1e6  # of any field, in its unit; float32 positions beyond it are 6 cm apart and coarser
MAX_ANCHOR_GAP_M = 0.1  # two ends of a joint farther apart than this are a mistake, not rounding


class LevelFormatError(ValueError):
    """A level document is wrong; the message names the field and the remedy in one line."""

    def __init__(self, path: str, problem: str, remedy: str) -> None:
        super().__init__(f"{path}: {problem}; {remedy}" if path else f"{problem}; {remedy}")
        self.path, self.problem, self.remedy = path, problem, remedy

    def in_file(self, file: object) -> LevelFormatError:
        """The same complaint with the file before the field."""
        return LevelFormatError(f"{file}: {self.path}" if self.path else str(file), self.problem, self.remedy)


def read_document(path: Path) -> Any:
    """The JSON document of a level file of either format; raises `LevelFormatError` naming the file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # also text that is not UTF-8, whole numbers of 4,300 digits
        raise LevelFormatError(str(path), f"is not JSON ({error})", "correct it at that place") from error


def validate_document(document: Any, capacity: Capacity, size_name: str | None = None) -> None:
    """Raises `LevelFormatError` for the first thing that is wrong with a level of at most this capacity.

    `size_name` is what messages call the capacity.
    """
    check_numbers(document, "")
    check_structure(document, levels_root() / "schema.json", see="docs/level_format.md")
    shapes = document["shapes"]
    for i, shape in enumerate(shapes):
        if shape["type"] == "polygon":
            check_polygon(shape["vertices"], f"shapes[{i}].vertices", capacity)
    names = _check_names(shapes)
    for i, joint in enumerate(document.get("joints", [])):
        _check_joint(joint, f"joints[{i}]", names)
    for i, thruster in enumerate(document.get("thrusters", [])):
        _check_reference(thruster["shape"], f"thrusters[{i}].shape", names)
        if "anchor" in thruster and "position" in thruster:
            raise LevelFormatError(
                f"thrusters[{i}]",
                "has both 'anchor' (world) and 'position' (frame of the shape)",
                "keep one of the two",
            )
    _check_roles(document)
    _check_room(document, capacity, size_name or str(capacity))


@functools.cache
def _structure_validator(schema_file: Path) -> Any:
    import jsonschema

    return jsonschema.Draft202012Validator(json.loads(schema_file.read_text(encoding="utf-8")))


def _path_text(parts: Any) -> str:
    text = ""
    for part in parts:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def check_numbers(value: Any, path: str) -> None:
    """Raises `LevelFormatError` for the first number in a JSON value that is not finite or beyond MAX_NUMBER."""
    if isinstance(value, float) and not math.isfinite(value):
        raise LevelFormatError(path, f"is {value}", "give a finite number")
    if isinstance(value, int | float) and abs(value) > MAX_NUMBER:
        raise LevelFormatError(path, f"is {_short(value)}", f"give a number between -{MAX_NUMBER:g} and {MAX_NUMBER:g}")
    if isinstance(value, dict):
        for key, inner in value.items():
            check_numbers(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            check_numbers(inner, f"{path}[{i}]")


def check_structure(document: Any, schema_file: Path, *, see: str) -> None:
    """Raises `LevelFormatError` for the first thing that a JSON schema does not allow; `see` describes the fields."""
    errors = _structure_validator(schema_file).iter_errors(document)
    errors = sorted(errors, key=lambda error: list(map(str, error.absolute_path)))
    if not errors:
        return
    error = errors[0]
    path = _path_text(error.absolute_path)
    limit, given = error.validator_value, error.instance
    if error.validator == "required":
        missing = next(name for name in limit if name not in given)
        raise LevelFormatError(f"{path}.{missing}".lstrip("."), "is missing", f"add {missing!r}")
    if error.validator == "additionalProperties":
        known = sorted(error.schema.get("properties", {}))
        unknown = next(name for name in given if name not in known)
        raise LevelFormatError(
            f"{path}.{unknown}".lstrip("."), "is not a field of the format", f"fields here: {', '.join(known)}"
        )
    if path == "size" and error.validator == "enum":
        raise LevelFormatError(path, f"unknown size {given!r}", f"use one of {', '.join(limit)}")
    if error.validator in ("enum", "const"):
        allowed = ", ".join(map(repr, limit)) if error.validator == "enum" else repr(limit)
        raise LevelFormatError(path, f"is {given!r}", f"use {allowed}")
    if error.validator == "type":
        raise LevelFormatError(path, f"is {_short(given)}", f"give a value of type {limit}")
    if error.validator in ("minItems", "maxItems"):
        bound = "at least" if error.validator == "minItems" else "at most"
        raise LevelFormatError(path, f"has {len(given)} entries", f"give {bound} {limit}")
    bounds = {
        "minimum": "at least",
        "maximum": "at most",
        "exclusiveMinimum": "more than",
        "exclusiveMaximum": "less than",
    }
    if error.validator in bounds:
        raise LevelFormatError(path, f"is {given}", f"give {bounds[error.validator]} {limit}")
    raise LevelFormatError(path, " ".join(error.message.split()), f"see {see}")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def check_polygon(vertices: list[list[float]], path: str, capacity: Capacity) -> None:
    """Raises `LevelFormatError` unless corners are few enough, convex, counter-clockwise and hold an area."""
    count = len(vertices)
    if count > capacity.vertices:
        raise LevelFormatError(path, f"has {count} corners", f"use at most {capacity.vertices}")
    turns, area = [], 0.0
    for i in range(count):
        before, here, after = vertices[i - 1], vertices[i], vertices[(i + 1) % count]
        edge_in = (here[0] - before[0], here[1] - before[1])
        edge_out = (after[0] - here[0], after[1] - here[1])
        if math.hypot(*edge_out) < 1e-9:
            raise LevelFormatError(f"{path}[{i}]", "is the same point as the next corner", "remove one of the two")
        turns.append(edge_in[0] * edge_out[1] - edge_in[1] * edge_out[0])
        area += 0.5 * (here[0] * after[1] - here[1] * after[0])
    if abs(area) < MIN_AREA_M2:
        raise LevelFormatError(path, f"polygon has an area of {abs(area):.1e} m^2", f"give at least {MIN_AREA_M2:.0e}")
    if area < 0 and all(turn <= 0 for turn in turns):
        raise LevelFormatError(path, "corners run clockwise", "list them counter-clockwise (reverse the order)")
    bad = [i for i, turn in enumerate(turns) if turn * area <= 0]
    if bad:
        raise LevelFormatError(path, f"polygon is not convex at corner {bad[0]}", "split it, or move that corner out")


def _check_names(shapes: list[dict[str, Any]]) -> list[str]:
    names = [shape["id"] for shape in shapes]
    for i, name in enumerate(names):
        if name in WALL_NAMES:
            raise LevelFormatError(f"shapes[{i}].id", f"{name!r} is the name of a wall", "give the shape another name")
        if name in names[:i]:
            raise LevelFormatError(f"shapes[{i}].id", f"{name!r} is used twice", "give each shape its own name")
    return names


def _check_reference(name: str, path: str, names: list[str]) -> None:
    if name not in names and name not in WALL_NAMES:
        raise LevelFormatError(path, f"there is no shape {name!r}", f"shapes are {', '.join([*names, *WALL_NAMES])}")


def _check_joint(joint: dict[str, Any], path: str, names: list[str]) -> None:
    for end in ("a", "b"):
        _check_reference(joint[end], f"{path}.{end}", names)
    if joint["a"] == joint["b"]:
        raise LevelFormatError(f"{path}.b", f"joins {joint['a']!r} to itself", "name another shape")
    given = tuple(name for name in ("anchor", "anchor_a", "anchor_b") if name in joint)
    if given not in (("anchor",), ("anchor_a", "anchor_b")):
        raise LevelFormatError(
            path,
            f"has {' and '.join(given) or 'no anchor'}",
            "give 'anchor' (world) or both 'anchor_a' and 'anchor_b' (frames of the shapes)",
        )
    limits = joint.get("limits")
    if limits is not None and limits[0] > limits[1]:
        raise LevelFormatError(f"{path}.limits", f"lower {limits[0]} is above upper {limits[1]}", "swap them")
    if limits is not None and joint["type"] == "fixed":
        raise LevelFormatError(f"{path}.limits", "a fixed joint has no limits", "remove them or use type 'revolute'")
    if joint["type"] == "prismatic" and "axis" not in joint:
        raise LevelFormatError(f"{path}.axis", "is missing", "give the angle (rad, frame of a) along which b slides")
    if joint["type"] != "prismatic" and "axis" in joint:
        raise LevelFormatError(
            f"{path}.axis", f"a {joint['type']} joint has no axis", "remove it or use type 'prismatic'"
        )


def check_anchor_gap(gap: tuple[float, float], path: str, *, axis: float | None = None) -> None:
    """Raises when the two anchors of a joint are too far apart: `gap`, m, from one to the other in the world.

    axis: of a slider, rad in the world: along it they may be apart.
    """
    apart = math.hypot(*gap) if axis is None else abs(math.cos(axis) * gap[1] - math.sin(axis) * gap[0])
    if apart > MAX_ANCHOR_GAP_M:
        across = "" if axis is None else " across its axis"
        raise LevelFormatError(
            path,
            f"its anchors are {apart:.3g} m apart{across}",
            f"move shapes or anchors to within {MAX_ANCHOR_GAP_M} m",
        )


def _check_roles(document: dict[str, Any]) -> None:
    holders = [*document["shapes"], *document.get("walls", {}).values()]
    roles = Counter(holder.get("role", "none") for holder in holders)
    for role in ("green", "blue"):
        if roles[role] != 1:
            raise LevelFormatError("shapes", f"{roles[role]} shapes are {role}", f"make exactly one shape {role}")


def _check_room(document: dict[str, Any], capacity: Capacity, size_name: str) -> None:
    circles = sum(shape["type"] == "circle" for shape in document["shapes"])
    counts = {
        "shapes": (len(document["shapes"]) - circles, capacity.polygons - NUM_WALLS, "boxes and polygons"),
        "shapes ": (circles, capacity.circles, "circles"),
        "joints": (len(document.get("joints", [])), capacity.joints, "joints"),
        "thrusters": (len(document.get("thrusters", [])), capacity.thrusters, "thrusters"),
    }
    for path, (count, room, kind) in counts.items():
        if count > room:
            raise LevelFormatError(
                path.strip(),
                f"{count} {kind}, size {size_name} has room for {room}",
                "use a larger size or remove some",
            )
