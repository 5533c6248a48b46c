"""Contact permissions and fitting: what may touch what, and moving a level into a larger size."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import Capacity
from kinetix_dist.level.derive import touch_permissions
from kinetix_dist.level.fit import LevelSizeError, capacity_of, fit_level, smallest_size, usage
from kinetix_dist.level.level import SIZES, Role
from kinetix_dist.level.level import Role as EnvRole
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.walls import FLOOR_TOP_M, empty_level
from tests.level.documents import cart_document


def permissions(**changes: object) -> np.ndarray:
    """Four loose shapes of mode 1 and two joint slots, with the given changes."""
    fields = {
        "shape_active": np.ones(4, bool),
        "is_fixed": np.zeros(4, bool),
        "collision_mode": np.ones(4, np.int32),
        "joint_active": np.zeros(2, bool),
        "joint_a": np.zeros(2, np.int32),
        "joint_b": np.zeros(2, np.int32),
    } | changes
    return np.asarray(jax.jit(touch_permissions)(**{name: jnp.asarray(field) for name, field in fields.items()}))


def test_loose_shapes_touch_all_but_themselves() -> None:
    np.testing.assert_array_equal(permissions(), ~np.eye(4, dtype=bool))


def test_joined_shapes_do_not_touch_directly_or_through_others() -> None:
    may = permissions(joint_active=[True, True], joint_a=[0, 1], joint_b=[1, 2])
    assert not may[0, 1] and not may[1, 2] and not may[0, 2]
    assert may[0, 3] and may[2, 3]
    np.testing.assert_array_equal(may, may.T)


def test_an_inactive_joint_joins_nothing() -> None:
    assert permissions(joint_active=[False, False], joint_a=[0, 1], joint_b=[1, 2])[0, 1]


def test_collision_modes_0_passes_through_1_and_0_but_not_2() -> None:
    may = permissions(collision_mode=[0, 1, 2, 0])
    assert not may[0, 1] and not may[0, 3] and may[0, 2] and may[1, 2] and may[3, 2]


def test_two_fixed_shapes_and_inactive_shapes_never_touch() -> None:
    may = permissions(is_fixed=[True, True, False, False], shape_active=[True, True, True, False])
    assert not may[0, 1] and may[0, 2] and not may[2, 3]


def test_the_empty_level_is_the_box_of_the_public_levels() -> None:
    level = empty_level(SIZES["s"])
    corners = level.position[:4, None] + level.scene.shapes.vertices[:4]
    np.testing.assert_allclose(corners[0, :, 1].max(), FLOOR_TOP_M, atol=1e-6)
    np.testing.assert_allclose(corners[1, :, 0].max(), 0.0, atol=1e-6)
    np.testing.assert_allclose(corners[2, :, 0].min(), 5.0, atol=1e-6)
    np.testing.assert_allclose(corners[3, :, 1].min(), 5.0, atol=1e-5)


def test_environment_and_levels_mean_the_same_roles() -> None:
    assert EnvRole is Role


def test_a_level_moved_into_a_larger_size_and_back_is_unchanged() -> None:
    level = level_from_json(cart_document())
    large = fit_level(level, SIZES["l"])
    assert capacity_of(large) == SIZES["l"] and usage(large) == usage(level)
    assert large.scene.joints.b[0] == SIZES["l"].polygons  # the wheel is the first circle there too
    back = fit_level(large, SIZES["m"])
    assert usage(back) == usage(level) and smallest_size(back) == "m"
    np.testing.assert_array_equal(back.position[:6], level.position[:6])
    np.testing.assert_array_equal(back.scene.joints.a, level.scene.joints.a)
    np.testing.assert_array_equal(back.scene.joints.b, level.scene.joints.b)
    active = level.scene.shapes.active
    np.testing.assert_array_equal(
        back.scene.shapes.can_touch[active][:, active], level.scene.shapes.can_touch[active][:, active]
    )


def test_a_level_too_large_for_a_size_is_refused_with_the_numbers() -> None:
    level = level_from_json(cart_document())
    with pytest.raises(LevelSizeError, match="level has 6 polygons, walls included; the size has room for 5"):
        fit_level(level, SIZES["s"])


def test_a_capacity_without_room_for_the_walls_is_refused() -> None:
    with pytest.raises(ValueError, match="a level needs 4 polygons"):
        empty_level(Capacity(polygons=3, circles=0, joints=0, thrusters=0))
