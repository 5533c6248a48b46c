"""Pictures in recordings: drawn back from foxglove.SceneUpdate messages alone, they are those of jax2d.draw."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.unknown_fields import UnknownFieldSet
from mcap.reader import make_reader
from mcap_protobuf.schema import build_file_descriptor_set

from jax2d.draw import draw
from jax2d.palette import BACKGROUND, ROLE_PALETTE
from jax2d.rasteriser import DEFAULT_VIEW
from jax2d.scene import JointKind, Springs
from kinetix_dist.evaluation.recordings import decode_level
from kinetix_dist.level.level import Role
from kinetix_dist.telemetry.recording import Rollout
from kinetix_dist.telemetry.sinks.mcap import FIXED_SCENE_TOPIC, SCENE_TOPIC, RolloutWriter
from tests.helpers import REPOSITORY
from tests.telemetry.scene_reader import SCHEMA, Entities, apply, picture, scene_updates
from tests.telemetry.worlds import BLUE_BOX, FLOOR, GREY_TRIANGLE, RED_BLOCK, falling_rollout, level

PIXELS_PER_METRE = 60.0
# Colours 0..255. Fills are the same; where edges and lines lie, both mix colours in other ways, and outlines are inside
# of edges there and upon them here: up to 2 pixels wide.
MAX_DIFFERENCE = 40
MAX_SHARE_OF_OTHERS = 0.03


def written(path: Path, *rollouts: Rollout) -> Path:
    writer = RolloutWriter(path)
    for rollout in rollouts:
        writer.write(rollout)
    writer.finish()
    return path


def shown_at(path: Path, time_ns: int) -> Entities:
    """Entities that a viewer has when it has played a file up to a time."""
    entities: Entities = {}
    for topic, log_time, update in scene_updates(path):
        if log_time <= time_ns:
            apply(entities, topic, update)
    return entities


def drawn(rollout: Rollout, state: int) -> np.ndarray:
    """The picture of a state with the flames that are commanded in it."""
    pose = SimpleNamespace(position=rollout.position[state], angle=rollout.angle[state])
    thrust = rollout.thruster[state] if state < rollout.num_steps else None
    roles = np.asarray(rollout.level.shape_role)
    return draw(rollout.level.scene, pose, roles, thrust=thrust, pixels_per_metre=PIXELS_PER_METRE)


def assert_alike(ours: np.ndarray, theirs: np.ndarray) -> None:
    difference = np.abs(ours.astype(int) - theirs.astype(int)).max(axis=-1)
    assert (difference > MAX_DIFFERENCE).mean() < MAX_SHARE_OF_OTHERS
    assert (difference <= 1).mean() > 0.9  # fills are the same colours


def falling(**scene_parts: Any) -> Rollout:
    """The rollout of worlds.py whose motor always drives forward: pictures show it in one colour."""
    rollout = falling_rollout(20)
    scene = dataclasses.replace(rollout.level.scene, **scene_parts)
    forward = np.ones_like(rollout.motor)
    return dataclasses.replace(rollout, level=dataclasses.replace(level(), scene=scene), motor=forward)


def with_joint(kind: JointKind) -> Rollout:
    joints = level().scene.joints
    return falling(joints=dataclasses.replace(joints, kind=np.full_like(joints.kind, kind)))


def with_spring() -> Rollout:
    ends = {"a": np.array([BLUE_BOX], np.int32), "b": np.array([GREY_TRIANGLE], np.int32)}
    anchors = {name: np.zeros((1, 2), np.float32) for name in ("anchor_a", "anchor_b")}
    names = ("rest_length", "stiffness", "damping", "min_length", "max_length")
    numbers = dict.fromkeys(names, np.ones(1, np.float32))
    return falling(springs=Springs(active=np.array([True]), **ends, **anchors, **numbers))


WORLDS = {
    "hinge with a motor": falling,
    "weld": lambda: with_joint(JointKind.FIXED),
    "slider": lambda: with_joint(JointKind.PRISMATIC),
    "spring": with_spring,
}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("state", [0, 7, 19])  # the thruster is off, on, on
def test_a_picture_drawn_back_from_the_messages_is_that_of_the_state(tmp_path: Path, world: str, state: int) -> None:
    rollout = WORLDS[world]()
    entities = shown_at(written(tmp_path / "a.mcap", rollout), round(rollout.seconds[state] * 1e9))
    assert_alike(picture(entities, BACKGROUND, DEFAULT_VIEW, PIXELS_PER_METRE), drawn(rollout, state))


@pytest.mark.parametrize("name", ["m/lift", "l/lunar_lander", "l/walker"])
def test_a_level_of_the_library_is_drawn_back(tmp_path: Path, name: str) -> None:
    text = (REPOSITORY / "levels" / f"{name}.json").read_text()
    rollout = still(text)
    entities = shown_at(written(tmp_path / "a.mcap", rollout), 0)
    assert_alike(picture(entities, BACKGROUND, DEFAULT_VIEW, PIXELS_PER_METRE), drawn(rollout, 0))


def still(text: str) -> Rollout:
    """A step of a level in which nothing moves, and all motors and thrusters are driven."""
    decoded = decode_level(text)
    scene = decoded.scene

    def twice(values: Any) -> np.ndarray:
        return np.repeat(np.asarray(values, np.float32)[None], 2, axis=0)

    return dataclasses.replace(
        falling_rollout(1),
        level=decoded,
        position=twice(decoded.position),
        angle=twice(decoded.angle),
        velocity=twice(decoded.velocity),
        angular_velocity=twice(decoded.angular_velocity),
        motor=np.ones((1, *np.shape(scene.joints.active)), np.float32),
        thruster=np.ones((1, *np.shape(scene.thrusters.active)), np.float32),
    )


def test_messages_are_of_the_schema_that_foxglove_publishes(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", falling())
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        [schema] = [schema for schema in summary.schemas.values() if schema.name == SCHEMA]
        messages = [(channel.topic, m) for _, channel, m in reader.iter_messages([SCENE_TOPIC, FIXED_SCENE_TOPIC])]
    assert FileDescriptorSet.FromString(schema.data) == build_file_descriptor_set(SceneUpdate)
    assert len(messages) == 1 + 21
    for _, message in messages:
        update = SceneUpdate.FromString(message.data)
        assert len(UnknownFieldSet(update)) == 0
        times = {entity.timestamp.ToNanoseconds() for entity in update.entities}
        assert times == {message.log_time}
        assert {entity.frame_id for entity in update.entities} == {"world"}


def test_what_is_fixed_is_written_once_a_rollout_and_what_moves_in_every_state(tmp_path: Path) -> None:
    updates = scene_updates(written(tmp_path / "a.mcap", falling(), falling()))
    fixed = [{entity.id for entity in update.entities} for topic, _, update in updates if topic == FIXED_SCENE_TOPIC]
    moving = [{entity.id for entity in update.entities} for topic, _, update in updates if topic == SCENE_TOPIC]
    assert fixed == [{f"shape {FLOOR}", f"shape {RED_BLOCK}"}] * 2
    assert moving == [{"shape 1", "shape 2", "shape 3", "shape 5", "joint 0", "thruster 0"}] * 42


def test_the_parts_of_a_rollout_are_gone_in_the_next_one(tmp_path: Path) -> None:
    rollout = falling()
    shapes = rollout.level.scene.shapes
    without_block = np.array(shapes.active)
    without_block[RED_BLOCK] = without_block[GREY_TRIANGLE] = False
    second = falling(shapes=dataclasses.replace(shapes, active=without_block))
    path = written(tmp_path / "a.mcap", rollout, second)
    last = max(time for _, time, _ in scene_updates(path))
    assert {id for _, id in shown_at(path, 0)} - {id for _, id in shown_at(path, last)} == {
        f"shape {RED_BLOCK}",
        f"shape {GREY_TRIANGLE}",
    }


def test_shapes_have_the_colours_of_their_roles(tmp_path: Path) -> None:
    entities = shown_at(written(tmp_path / "a.mcap", falling()), 0)
    [blue] = entities[SCENE_TOPIC, f"shape {BLUE_BOX}"].triangles
    assert [round(255 * value) for value in (blue.color.r, blue.color.g, blue.color.b)] == [*ROLE_PALETTE[Role.BLUE]]
    assert blue.color.a == 1.0
