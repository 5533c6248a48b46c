"""Check of a level document for an editor: all problems, or warnings and facts."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from kinetix_dist.level.fit import capacity_of_size, usage
from kinetix_dist.level.kinetix_format import is_kinetix_document
from kinetix_dist.level.level import NUM_WALLS, SIZES, Level, motors_with_effect, pushing_thrusters
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.start_warnings import StartWarning, paths_in, start_warnings
from kinetix_dist.level.validate import LevelFormatError, problems_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class Checked:
    """Result of a check. Without problems there is a level."""

    problems: tuple[LevelFormatError, ...]
    level: Level | None = None  # numpy
    warnings: tuple[StartWarning, ...] = ()
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)


def check_document(document: Any) -> Checked:
    """Checks a document: all problems at once; without any the level, warnings and facts. Nothing is simulated."""
    problems = tuple(_problems(document))
    if problems:
        return Checked(problems=problems)
    level = level_from_json(document)
    return Checked(
        problems=(),
        level=level,
        warnings=tuple(start_warnings(level, document)),
        facts=facts_of(level, document),
    )


def _problems(document: Any) -> list[LevelFormatError]:
    if is_kinetix_document(document):
        return [LevelFormatError("", "is a level of the public package", "convert it to this format first")]
    if not isinstance(document, dict):
        return [LevelFormatError("", f"is {type(document).__name__}", "give a JSON object")]
    size = document.get("size")
    # A document without a size, itself a problem, is checked against the largest size.
    name = size if isinstance(size, str) and size in SIZES else list(SIZES)[-1]
    return list(problems_of(document, capacity_of_size(name), name))


def facts_of(level: Level, document: dict[str, Any]) -> dict[str, Any]:
    """Counts and free slots of each kind, masses (kg, by path; None: fixed), and colours that drive something."""
    scene, capacity, used = level.scene, SIZES[document["size"]], usage(level)
    inverse_mass = np.asarray(scene.shapes.inverse_mass, float)
    masses = {
        path: 1 / inverse_mass[slot] if inverse_mass[slot] > 0 else None
        for slot, path in paths_in(level, document).shapes.items()
        if slot >= NUM_WALLS
    }
    driven, pushed = motors_with_effect(level), pushing_thrusters(level)
    return {
        "counts": used | {"polygons": used["polygons"] - NUM_WALLS},
        "free": {kind: getattr(capacity, kind) - count for kind, count in used.items()},
        "masses": masses,
        "motor_colours": sorted(set(np.asarray(level.motor_colour)[driven].tolist())),
        "thruster_colours": sorted(set(np.asarray(level.thruster_colour)[pushed].tolist())),
    }
