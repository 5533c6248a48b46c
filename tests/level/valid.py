"""Facts of every level, whatever its source: the checks that files and engines have, for a batch at once."""

from __future__ import annotations

import numpy as np

from jax2d import Capacity
from jax2d.checks import check_scene
from kinetix_dist.level.level import NUM_WALLS, Level, Role
from kinetix_dist.level.walls import empty_level


def assert_valid(level: Level, capacity: Capacity, *, max_red: int = 1, may_touch: bool = True) -> None:
    """level: a batch, numpy. may_touch: green can touch blue, else a level could not be solved."""
    num_levels = len(level.position)
    scene, joints, thrusters = level.scene, level.scene.joints, level.scene.thrusters
    check_scene(scene, capacity, np.dtype(np.float32), batch=(num_levels,))
    for role, most, least in ((Role.GREEN, 1, 1), (Role.BLUE, 1, 1), (Role.RED, max_red, 0)):
        count = (scene.shapes.active & (level.shape_role == role)).sum(axis=1)
        assert least <= count.min() and count.max() <= most
    row = np.arange(num_levels)
    green, blue = (
        np.argmax(scene.shapes.active & (level.shape_role == role), axis=1) for role in (Role.GREEN, Role.BLUE)
    )
    assert not may_touch or scene.shapes.can_touch[row, green, blue].all()
    of = np.arange(num_levels)[:, None]
    assert (scene.shapes.active[of, joints.a] | ~joints.active).all()
    assert (scene.shapes.active[of, joints.b] | ~joints.active).all()
    assert ((joints.a != joints.b) | ~joints.active).all()
    assert (scene.shapes.active[of, thrusters.body] | ~thrusters.active).all()
    assert ((scene.shapes.inverse_mass[of, thrusters.body] > 0) | ~thrusters.active).all()
    gap = np.linalg.norm(world(level, joints.a, joints.anchor_a) - world(level, joints.b, joints.anchor_b), axis=-1)
    assert (gap * joints.active).max() < 1e-4
    fixed = scene.shapes.active & (scene.shapes.inverse_mass == 0)
    assert (level.velocity[fixed] == 0).all()
    walls = empty_level(capacity)
    np.testing.assert_array_equal(level.position[:, :NUM_WALLS], walls.position[None, :NUM_WALLS].repeat(num_levels, 0))
    assert (scene.shapes.active[:, :NUM_WALLS] & fixed[:, :NUM_WALLS]).all()


def world(level: Level, end: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """[L, J, 2] m, where an anchor is in the world."""
    of = np.arange(len(end))[:, None]
    angle, position = level.angle[of, end], level.position[of, end]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = anchor[..., 0], anchor[..., 1]
    return position + np.stack([cos * x - sin * y, sin * x + cos * y], -1)
