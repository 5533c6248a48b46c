"""Ready-made mechanisms: valid in a level with a goal, of the elements that their names promise."""

from __future__ import annotations

import numpy as np
import pytest

from kinetix_dist.level.document import LevelInfo, level_to_json
from kinetix_dist.level.mechanisms.ready_made import READY_MADE, ready_made_level
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.start_warnings import start_warnings

# Boxes, circles, joints and thrusters, as drawn for a level of size M.
COUNTS = {
    "car": (1, 2, 2, 0),
    "arm": (2, 1, 2, 0),
    "hopper": (4, 0, 3, 0),
    "lander": (1, 0, 0, 2),
    "cannon": (4, 0, 0, 1),
}
GOAL = {"id": "goal", "type": "circle", "radius": 0.1, "position": [0.3, 4.7], "role": "blue", "fixed": True}


@pytest.mark.parametrize("name", READY_MADE)
def test_a_level_with_the_mechanism_and_a_goal_has_no_problem_and_no_warning(name: str) -> None:
    document = level_to_json(ready_made_level(name, "m"), LevelInfo(name=name, size="l"))
    circles = [shape for shape in document["shapes"] if shape["type"] == "circle"]
    counts = (len(document["shapes"]) - len(circles), len(circles), len(document["joints"]), len(document["thrusters"]))
    assert counts == COUNTS[name]
    assert [shape.get("role") for shape in document["shapes"]].count("green") == 1
    document["shapes"].append(GOAL)
    level = level_from_json(document)  # raises for an invalid one
    assert start_warnings(level, document) == []


def test_wheels_have_one_colour_and_links_their_own() -> None:
    car, hopper = (
        level_to_json(ready_made_level(name, "l"), LevelInfo(name=name, size="l")) for name in ("car", "hopper")
    )
    assert [joint["motor"]["colour"] for joint in car["joints"]] == [0, 0]
    assert [joint["motor"]["colour"] for joint in hopper["joints"]] == [0, 1, 2]


def test_an_arm_has_as_many_links_as_its_level_has_room_for() -> None:
    links = {size: int(np.sum(ready_made_level("arm", size).scene.joints.active)) for size in ("s", "m", "l")}
    assert links == {"s": 1, "m": 2, "l": 3}
