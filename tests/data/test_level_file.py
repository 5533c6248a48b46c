"""Levels of a data set: which shapes are the robot, and that the same levels give the same bytes."""

from __future__ import annotations

import jax
import numpy as np

from kinetix_dist.data.collect import Collection
from kinetix_dist.data.level_file import describe_levels, encode_levels, robot_mask
from kinetix_dist.level.level import NUM_WALLS
from kinetix_dist.level.schema import level_from_json
from tests.level.documents import cart_document


def robot_of(document: dict) -> list[bool]:
    """Of the shapes of a document, polygons first."""
    level = jax.tree.map(lambda x: np.asarray(x)[None], level_from_json(document))
    [mask], [active] = robot_mask(level), np.asarray(level.scene.shapes.active)
    return mask[active][NUM_WALLS:].tolist()


def test_the_robot_is_what_motors_and_thrusters_move() -> None:
    assert robot_of(cart_document()) == [True, True, True, False]  # chassis, wedge (its thruster); wheel, not the goal


def test_what_no_action_drives_is_no_part_of_it() -> None:
    document = cart_document()
    document["joints"][0]["motor"]["auto"] = True  # it runs by itself
    del document["thrusters"]
    assert robot_of(document) == [False] * 4


def test_a_chain_of_joints_belongs_to_it_and_what_hangs_on_the_same_fixed_body_does_not() -> None:
    document = cart_document() | {"size": "l"}
    del document["thrusters"]
    hinge = {"type": "revolute", "anchor": [1.0, 1.0]}
    document["joints"] += [hinge | {"a": "goal", "b": "chassis"}, hinge | {"a": "wedge", "b": "goal"}]
    assert robot_of(document) == [True, False, True, False]  # the wedge hangs on the goal, as the chassis does
    document["joints"][-1] = hinge | {"a": "wedge", "b": "wheel"}
    assert robot_of(document) == [True, True, True, False]


def test_the_same_levels_give_the_same_bytes(collection: Collection) -> None:
    described = [describe_levels(collection.env, collection.levels, collection.level_names) for _ in range(2)]
    first, again = map(encode_levels, described)
    assert first == again
