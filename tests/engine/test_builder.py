"""SceneBuilder: what it builds is right, and what cannot be built is refused with the remedy."""

from __future__ import annotations

import dataclasses
import math

import jax
import numpy as np
import pytest

from jax2d import Capacity, SceneBuilder, SceneError, SceneFullError, preset
from jax2d.builder_options import (
    BodyKeywords,
    BodyOptions,
    PrismaticKeywords,
    PrismaticMotor,
    RevoluteKeywords,
    RevoluteMotor,
    SpringKeywords,
    SpringOptions,
)
from tests.engine.worlds import builder, run


def test_triangle_has_the_mass_centroid_and_inertia_of_the_textbook_wherever_it_is_authored():
    for offset in (0.0, 3.0):
        b = builder()
        b.add_polygon([(offset, 0), (offset + 3, 0), (offset, 3)], density=2.0)
        scene, position, *_ = b.build()
        mass = 2.0 * 4.5
        assert scene.shapes.inverse_mass[0] == pytest.approx(1 / mass)
        assert scene.shapes.inverse_inertia[0] == pytest.approx(1 / (mass * (9 + 9) / 18))
        np.testing.assert_allclose(position[0], [offset + 1, 1], atol=1e-6)


def test_disc_has_half_m_r_squared_of_inertia():
    b = builder()
    disc = b.add_circle(radius=0.5, density=3.0)
    scene = b.build().scene
    mass = 3.0 * math.pi * 0.25
    assert scene.shapes.inverse_inertia[disc] == pytest.approx(1 / (0.5 * mass * 0.25))


def test_jointed_shapes_may_not_touch():
    b = builder()
    a, c = b.add_box(width=1, height=1), b.add_circle(radius=0.5)
    b.add_revolute_joint(a, c, at=(0, 0))
    scene = b.build().scene
    assert not scene.shapes.can_touch[a, c]
    assert not scene.shapes.can_touch[c, a]


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        ([(0, 0), (1, 0), (0.2, 0.2), (0, 1)], "not convex"),
        ([(0, 0), (0, 1), (1, 1), (1, 0)], "clockwise"),
        ([(0, 0), (1, 0), (2, 0)], "area"),
        ([(0, 0), (1, 0), (1, 0), (0, 1)], "same point"),
        ([(0, 0), (1, 0), (math.nan, 1)], "NaN"),
        ([(0, 0), (1, 0)], "2 vertices"),
        ([(0, 0), (1, 0), (1,)], "no list of"),
        ([(math.cos(4 * k * math.pi / 5), math.sin(4 * k * math.pi / 5)) for k in range(5)], "not convex"),
    ],
)
def test_polygons_that_cannot_be_simulated_are_refused(vertices, message):
    b = SceneBuilder(Capacity(polygons=1, circles=0, joints=0, thrusters=0, vertices=5))
    with pytest.raises(SceneError, match=message):
        b.add_polygon(vertices)


def test_full_scene_names_the_capacity_to_build_with():
    b = SceneBuilder(Capacity(polygons=1, circles=0, joints=0, thrusters=0))
    b.add_box(width=1, height=1)
    with pytest.raises(SceneFullError, match=r"1 of 1 polygons used; build with Capacity\(polygons=2\)"):
        b.add_box(width=1, height=1)


def test_joint_to_itself_or_to_a_missing_shape_is_refused():
    b = builder()
    a = b.add_box(width=1, height=1)
    with pytest.raises(SceneError, match="itself"):
        b.add_fixed_joint(a, a, at=(0, 0))
    with pytest.raises(SceneError, match="no shape"):
        b.add_fixed_joint(a, 5, at=(0, 0))
    for index in (0.0, True, None, "0", -1, 10**9):
        with pytest.raises(SceneError, match=f"a is {index!r}, which is no shape of this scene"):
            b.add_fixed_joint(index, a, at=(0, 0))  # type: ignore[arg-type]
    with pytest.raises(SceneError, match="shape 0 kept apart from itself"):
        b.keep_apart(a, a)


def test_joints_and_thrusters_that_could_move_nothing_are_refused():
    b = builder()
    a, c = b.add_box(width=1, height=1, fixed=True), b.add_circle(radius=1, fixed=True)
    with pytest.raises(SceneError, match=f"joint of shapes {a} and {c}, which are both fixed"):
        b.add_revolute_joint(a, c, at=(0, 0))
    with pytest.raises(SceneError, match=f"thruster on shape {a}, which is fixed"):
        b.add_thruster(a, at=(0, 0), angle=0.0)


def test_limits_hold_how_the_shapes_stand():
    b = builder()
    a, c = b.add_box(width=1, height=1), b.add_circle(radius=1)
    for limits in ((0.5, 1.0), (-1.0, -0.5)):
        with pytest.raises(SceneError, match="leave out 0, which is how the shapes stand now"):
            b.add_revolute_joint(a, c, at=(0, 0), limits=limits)
    with pytest.raises(SceneError, match="limits 1 to -1 are empty"):
        b.add_revolute_joint(a, c, at=(0, 0), limits=(1, -1))
    b.add_revolute_joint(a, c, at=(0, 0), limits=(0.0, 1.0))


def test_a_refused_call_adds_nothing():
    def filled() -> SceneBuilder:
        b = builder()
        b.add_box(width=1, height=1)
        b.add_circle(radius=1)
        return b

    b = filled()
    for refused in (
        lambda: b.add_box(width=1, height=1, density=-1),
        lambda: b.add_box(width=1, height=1, position=(0, math.inf)),
        lambda: b.add_circle(radius=1, restitution=2),
        lambda: b.add_circle(radius=1, angle=math.nan),
        lambda: b.add_revolute_joint(0, 7, at=(0, 0), limits=(1, -1)),
        lambda: b.add_revolute_joint(0, 7, at=(0, 0), motor_speed=math.inf),
        lambda: b.add_fixed_joint(0, 7, at=(0, math.nan)),
        lambda: b.add_thruster(0, at=(0, 0), angle=math.inf),
        lambda: b.add_thruster(0, at=(0, 0), angle=0.0, power=-1),
        lambda: b.keep_apart(0, 6),
    ):
        with pytest.raises(SceneError):
            refused()
    jax.tree.map(np.testing.assert_array_equal, b.build(), filled().build())
    assert b.add_circle(radius=1) == 8
    assert b.add_thruster(0, at=(0, 0), angle=0.0) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"density": 0.0}, "density"),
        ({"friction": -1.0}, "friction"),
        ({"restitution": 1.5}, "restitution"),
        ({"position": (math.inf, 0)}, "position"),
        ({"fixed": True, "velocity": (1, 0)}, "fixed"),
        ({"friction": math.inf}, "friction is inf; give a finite number"),
        ({"friction": "rough"}, "friction is 'rough'; give a finite number"),
        ({"angle": math.inf}, "angle is inf; give a finite number"),
        ({"position": 1.0}, "position is 1.0; give 2 finite numbers"),
        ({"position": (1, None)}, "position is .* give 2 finite numbers"),
        ({"density": 1e-30}, "a mass of 3.14159e-30 kg .*: change its size or density"),
        ({"density": 1e46}, "density is 1e.46; give a finite number"),
        ({"radius": 1e-10}, "radius is 1e-10; it must be at least 5.6e-05 m"),
        ({"radius": 1e15}, "an inertia of .*: change its size or density"),
    ],
)
def test_numbers_that_make_no_body_are_refused(options, message):
    with pytest.raises(SceneError, match=message):
        builder().add_circle(**{"radius": 1.0} | options)


# Who may touch whom, and friction


@pytest.mark.parametrize(
    ("one", "other", "touch"),
    [
        ({}, {}, True),
        ({"category": 2}, {"mask": 1}, False),
        ({"category": 2, "mask": 4}, {"category": 4, "mask": 2}, True),
        ({"category": 2, "mask": 4}, {"category": 4, "mask": 1}, False),  # both ways
        ({"category": 6}, {"mask": 4}, True),  # one bit is enough
        ({"category": 0}, {}, False),
        ({"category": 2**15}, {"mask": 2**15}, True),
    ],
)
def test_categories_and_masks_say_who_may_touch_whom(one: dict, other: dict, touch: bool):
    b = builder()
    pair = b.add_box(width=1, height=1, **one), b.add_circle(radius=1, **other)
    b.add_circle(radius=1)
    can_touch = b.build().scene.shapes.can_touch
    assert can_touch[pair] == can_touch[pair[::-1]] == touch
    np.testing.assert_array_equal(can_touch, can_touch.T)


@pytest.mark.parametrize("name", ["standard", "paper"])
def test_friction_coefficient_is_what_two_like_shapes_have(name: str):
    """A box slides to a stop after v^2 / (2 mu g)."""
    b, mu, speed = builder(), 0.3, 2.0
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction_coefficient=mu)
    box = b.add_box(width=1, height=0.5, position=(0, 0.25), velocity=(speed, 0), friction_coefficient=mu)
    end = run(b.build(), 1.5, settings=preset(name))
    assert end.position[box, 0] == pytest.approx(speed**2 / (2 * mu * 9.81), rel=0.03)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"category": 65536}, "category is 65536; it has 16 bits: give 0 to 65535"),
        ({"mask": -1}, "mask is -1; it has 16 bits"),
        ({"category": 1.0}, "category is 1.0; it must be a whole number"),
        (
            {"friction": 1.0, "friction_coefficient": 0.5},
            "friction 1.0 and friction_coefficient 0.5 are the same in two",
        ),
        ({"friction_coefficient": -0.1}, "friction_coefficient is -0.1; it must be 0 or more"),
    ],
)
def test_filters_and_coefficients_that_are_none_are_refused(options: dict, message: str):
    with pytest.raises(SceneError, match=message):
        builder().add_circle(radius=1.0, **options)


def test_keywords_that_an_editor_completes_are_the_fields_of_the_records() -> None:
    for keywords, record in (
        (BodyKeywords, BodyOptions),
        (RevoluteKeywords, RevoluteMotor),
        (PrismaticKeywords, PrismaticMotor),
        (SpringKeywords, SpringOptions),
    ):
        assert set(keywords.__annotations__) == {field.name for field in dataclasses.fields(record)}
