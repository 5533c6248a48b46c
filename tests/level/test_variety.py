"""Levels with other physics: what changes, by how much, and what must not."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest

from jax2d.engine import Engine
from jax2d.scene import Controls
from kinetix_dist.level.derive import derive
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig, generator
from kinetix_dist.level.level import NUM_WALLS, SIZES, Level, Role
from kinetix_dist.level.variety import _hung_on_wall
from tests.level.valid import assert_valid

NUM_LEVELS = 512


@functools.cache
def levels_of(size: str, share: float, name: str = "default") -> Level:
    config = dataclasses.replace(generator(name), varied_share=share)
    return jax.tree.map(np.asarray, generate_levels(jax.random.key(5), NUM_LEVELS, SIZES[size], config))


def bodies(levels: Level, world: int) -> list[set[int]]:
    """Shapes that joints hold together, found by walking."""
    joints = levels.scene.joints
    groups = [{shape} for shape in range(levels.angle.shape[1])]
    for joint in np.flatnonzero(joints.active[world]):
        ends = [next(g for g in groups if end[world, joint] in g) for end in (joints.a, joints.b)]
        if ends[0] is not ends[1]:
            groups.remove(ends[1])
            ends[0].update(ends[1])
    return groups


@pytest.mark.parametrize(
    ("size", "name"),
    [("s", "default"), *(pytest.param("l", name, marks=pytest.mark.long) for name in ("default", "tasks"))],
)
def test_a_varied_level_is_valid_and_looks_as_before(size: str, name: str) -> None:
    plain, varied = levels_of(size, 0.0, name), levels_of(size, 1.0, name)
    assert_valid(varied, SIZES[size], max_red=SIZES[size].shapes)
    shapes, before = varied.scene.shapes, plain.scene.shapes
    for path in ("vertices", "radius", "num_vertices"):
        np.testing.assert_allclose(getattr(shapes, path), getattr(before, path), atol=1e-5)
    is_gone = before.active & ~shapes.active
    assert (shapes.active <= before.active).all() and (is_gone.sum(axis=1) <= 1).all()
    assert (before.inverse_mass[is_gone] == 0).all() and (plain.shape_role[is_gone] == Role.NONE).all()
    assert is_gone.any() == (size != "s")  # no random level of S has a fixed shape
    joints, on_wall = varied.scene.joints, is_gone.any(axis=1)
    np.testing.assert_array_equal((joints.active & (joints.a < NUM_WALLS)).any(axis=1), on_wall)
    np.testing.assert_allclose(varied.position, plain.position, atol=1e-5)
    np.testing.assert_array_equal(varied.scene.joints.active, plain.scene.joints.active)
    was_red = plain.shape_role == Role.RED
    np.testing.assert_array_equal(varied.shape_role[was_red], plain.shape_role[was_red])
    green_or_blue = np.isin(plain.shape_role, (Role.GREEN, Role.BLUE))
    np.testing.assert_array_equal(varied.shape_role[green_or_blue], plain.shape_role[green_or_blue])


def test_each_change_is_made_to_half_of_the_levels_within_its_limits() -> None:
    plain, varied = levels_of("l", 0.0), levels_of("l", 1.0)
    shapes, joints, thrusters = varied.scene.shapes, varied.scene.joints, varied.scene.thrusters
    exists = shapes.active & (np.arange(shapes.active.shape[1]) >= NUM_WALLS)
    moves = exists & (shapes.inverse_mass > 0)

    def share(changed: np.ndarray, where: np.ndarray) -> float:
        """Share of the levels that have something to change."""
        return np.any(changed & where, axis=1)[np.any(where, axis=1)].mean()

    has_motor = joints.active & joints.motor_on
    power = np.where(has_motor, joints.motor_power / np.where(has_motor, plain.scene.joints.motor_power, 1), 1)
    push = np.where(thrusters.active, thrusters.power / np.where(thrusters.active, plain.scene.thrusters.power, 1), 1)
    gravity = varied.scene.gravity[:, 1:] / plain.scene.gravity[:, 1:]
    speed = np.abs(varied.velocity).max(axis=-1)
    for value, low, high, where in (
        (power, 0.05, 2.0, has_motor),
        (push, 0.1, 1.5, thrusters.active),
        (gravity, 0.2, 1.1, np.ones_like(gravity, bool)),
        (shapes.density, 0.5, 4.0, moves),
        (shapes.friction, 0.1, 1.2, exists),
    ):
        assert value[where].min() > low - 1e-3 and value[where].max() < high + 1e-3
        assert 0.4 < share(np.abs(value - 1.0) > 1e-6, where) < 0.6
    assert speed[moves].max() < 1.5 + 1e-6 and not speed[shapes.active & (shapes.inverse_mass == 0)].any()
    assert 0.3 < (speed > 0).any(axis=1).mean() < 0.6
    # Mass follows from density, in every level: mass by the engine's own formula is what `assert_valid` compares.
    heavier = (shapes.density > 1.01) & moves
    assert (shapes.inverse_mass[heavier] < plain.scene.shapes.inverse_mass[heavier]).all()


def test_what_hangs_on_a_wall_moves_as_on_the_disc_before() -> None:
    """Arms of four links with all motors on, played on the engine."""
    arms = levels_of("l", 0.0, "arm")
    walls = 1 + jax.numpy.arange(NUM_LEVELS) % (NUM_WALLS - 1)
    hung = jax.jit(jax.vmap(lambda level, wall: derived(_hung_on_wall(level, wall))))(arms, walls)
    hung = jax.tree.map(np.asarray, hung)
    capacity = SIZES["l"]
    engine = Engine(capacity)
    states = []
    motors, thrusters = (np.ones((NUM_LEVELS, n), np.float32) for n in (capacity.joints, capacity.thrusters))
    controls = Controls(motor=motors, thruster=thrusters)
    for levels in (arms, hung):
        state = engine.initial_state(levels.scene, levels.position, levels.angle)
        states.append(jax.device_get(engine.step(levels.scene, state, controls, num_steps=20)[0]))
    there = hung.scene.shapes.active
    assert (arms.scene.shapes.active.sum(axis=1) - there.sum(axis=1) == 1).all()
    off = np.abs(states[0].position - states[1].position).max(axis=-1) * there
    moved = np.abs(states[0].position - arms.position).max(axis=-1) * there
    assert np.quantile(moved.max(axis=1), 0.1) > 0.1
    assert np.quantile(off.max(axis=1), 0.9) < 2e-3  # rounding of anchors in the frame of a wall; contacts are chaotic


def test_what_is_hung_is_held_at_the_same_points_and_angles_and_pushes_on_nothing_that_is_gone() -> None:
    """Each joint's own numbers, in the frames of shapes that are turned."""
    plain, varied = levels_of("l", 0.0), levels_of("l", 1.0)
    joints, thrusters = varied.scene.joints, varied.scene.thrusters
    is_gone = plain.scene.shapes.active & ~varied.scene.shapes.active
    is_hung = np.zeros(NUM_LEVELS, bool)
    row = np.arange(NUM_LEVELS)
    for joint in range(joints.active.shape[1]):
        seen = []
        for levels in (plain, varied):
            now = levels.scene.joints
            a, b = now.a[:, joint], now.b[:, joint]
            ends = [
                point_of(levels, row, a, now.anchor_a[:, joint]),
                point_of(levels, row, b, now.anchor_b[:, joint]),
            ]
            # What the angle of b against a is off the angle that limits count from, whichever end is called a.
            off = levels.angle[row, b] - levels.angle[row, a] - now.rest_angle[:, joint]
            seen.append((np.stack(ends).mean(axis=0), np.abs(np.angle(np.exp(1j * off)))))
        exists = joints.active[:, joint]
        assert np.abs(seen[0][0] - seen[1][0])[exists].max() < 1e-4
        assert np.abs(seen[0][1] - seen[1][1])[exists].max() < 1e-3
        to_wall = exists & (np.minimum(joints.a[:, joint], joints.b[:, joint]) < NUM_WALLS)
        is_hung |= to_wall
    assert 0.02 < is_hung.mean() < 0.3 and (is_hung == is_gone.any(axis=1)).all()
    turned = np.abs(np.sin(2 * plain.angle[is_gone])) > 0.1
    assert turned.any()
    for world, thruster in np.argwhere(thrusters.active):
        assert varied.scene.shapes.active[world, thrusters.body[world, thruster]]


def point_of(levels: Level, row: np.ndarray, shape: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """[n, 2] in the world."""
    angle, position = levels.angle[row, shape], levels.position[row, shape]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = anchor[:, 0], anchor[:, 1]
    return position + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def derived(level: Level) -> Level:
    shapes = level.scene.shapes
    return derive(level, shapes.active & (shapes.inverse_mass == 0))


def test_what_is_joined_begins_to_move_as_one_or_not_at_all() -> None:
    levels = levels_of("l", 1.0)
    shapes = levels.scene.shapes
    for world in range(64):
        for body in bodies(levels, world):
            members = sorted(shape for shape in body if shapes.active[world, shape])
            velocities = levels.velocity[world, members]
            if len(members) and (shapes.inverse_mass[world, members] == 0).any():
                assert not velocities.any()
            elif len(members):
                assert (velocities == velocities[0]).all()


def test_only_a_goal_that_nothing_holds_or_drives_is_fixed() -> None:
    plain, varied = levels_of("s", 0.0), levels_of("s", 1.0)
    is_new = (varied.scene.shapes.inverse_mass == 0) & (plain.scene.shapes.inverse_mass > 0)
    assert 0.1 < is_new.any(axis=1).mean() < 0.6
    assert (varied.shape_role[is_new] == Role.BLUE).all()
    joints, thrusters = varied.scene.joints, varied.scene.thrusters
    for world, shape in np.argwhere(is_new):
        assert shape not in joints.a[world][joints.active[world]]
        assert shape not in joints.b[world][joints.active[world]]
        assert shape not in thrusters.body[world][thrusters.active[world]]


def test_a_share_of_the_levels_is_varied_and_the_others_are_as_without() -> None:
    plain, mixed, varied = (levels_of("s", share) for share in (0.0, 0.3, 1.0))

    def same(one: Level, other: Level) -> np.ndarray:
        leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
        close = [np.isclose(a, b, rtol=1e-5, atol=1e-6).reshape(NUM_LEVELS, -1).all(axis=1) for a, b in leaves]
        return np.all(close, axis=0)

    is_plain, is_varied = same(mixed, plain), same(mixed, varied)
    assert (is_plain | is_varied).all()
    assert abs((~is_plain).mean() - 0.3) < 0.08


def test_a_share_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"varied_share is -0\.1; it must be from 0 to 1"):
        GeneratorConfig(varied_share=-0.1)
