"""Worlds with one of everything that can be drawn, for comparing pictures."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from jax2d import Capacity, SceneBuilder
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import load_level

LEVELS = ("s/swing_up", "m/lift", "m/rocket_car", "l/walker", "l/lunar_lander", "l/gears", "l/grasp")
SMALL = 30.0  # pixels a metre


def everything() -> dict[str, Any]:
    """Arguments of `draw`: belts, sliders with and without limits, a weld, springs, ropes, kinematic shapes, trails."""
    b = SceneBuilder(
        Capacity(polygons=7, circles=3, joints=5, thrusters=2, springs=3, vertices=6, extended_shapes=True)
    )
    floor = b.add_box(width=5, height=0.4, position=(2.5, 0.2), fixed=True, surface_speed=1.5)
    cart = b.add_box(width=0.8, height=0.3, position=(1.2, 1.0), angle=0.1)
    lift = b.add_box(width=0.4, height=0.4, position=(1.5, 2.0))
    arm = b.add_polygon([(-0.4, -0.1), (0.3, -0.15), (0.5, 0.1), (0.1, 0.3), (-0.3, 0.2)], position=(3.0, 2.0))
    tail = b.add_box(width=0.5, height=0.2, position=(3.6, 2.1), angle=0.4)
    b.add_box(width=0.2, height=0.9, position=(4.5, 1.2), kinematic=True)
    wheel = b.add_circle(radius=0.3, position=(1.0, 0.7), surface_speed=-1.0)
    ball = b.add_circle(radius=0.2, position=(4.0, 3.5))
    b.add_prismatic_joint(cart, lift, at=(1.4, 1.5), axis_angle=1.4, limits=(-0.2, 0.7), motor_speed=1.0)
    b.add_prismatic_joint(floor, cart, at=(1.2, 0.9), axis_angle=0.0)
    b.add_revolute_joint(cart, wheel, at=(1.0, 0.7), motor_speed=2.0)
    b.add_revolute_joint(arm, floor, at=(2.7, 1.9))
    b.add_fixed_joint(arm, tail, at=(3.35, 2.05))
    b.add_spring(arm, ball, at_a=(3.2, 2.2), at_b=(4.0, 3.5), stiffness=20.0, rest_length=1.0)
    b.add_rope(tail, ball, at_a=(3.8, 2.2), at_b=(4.1, 3.4))
    b.add_thruster(lift, at=(1.5, 1.85), angle=1.5, power=2.0)
    b.add_thruster(arm, at=(3.3, 1.9), angle=2.8, power=2.0)
    world = b.build()
    num_shapes = world.position.shape[0]
    steps = np.linspace(0, 1, 6)[:, None]
    return {
        "scene": world.scene,
        "state": SimpleNamespace(position=world.position, angle=world.angle),
        "roles": np.arange(num_shapes) % 4,
        "thrust": np.array([0.8, 0.3]),
        "motor_colours": np.array([1, 0, 3, 2, 0]),
        "thruster_colours": np.array([1, 0]),
        "trails": [np.array([4.0, 3.5]) - steps * [1.5, 0.7]],
        "view": (-0.1, -0.1, 5.1, 4.2),
        "pixels_per_metre": 60.0,
    }


def levels() -> dict[str, dict[str, Any]]:
    """Arguments of `draw` of designed levels, bodies a little off their start, thrusters firing."""
    pictures = {}
    for number, name in enumerate(LEVELS):
        level, _ = load_level(levels_root() / f"{name}.json")
        draws = np.random.default_rng(number)
        moves = np.asarray(level.scene.shapes.inverse_mass) > 0
        position = np.asarray(level.position, float) + draws.normal(0, 0.05, level.position.shape) * moves[:, None]
        angle = np.asarray(level.angle, float) + draws.normal(0, 0.3, level.angle.shape) * moves
        pictures[name] = {
            "scene": level.scene,
            "state": SimpleNamespace(position=position, angle=angle),
            "roles": level.shape_role,
            "thrust": draws.uniform(0, 1, len(level.thruster_colour)),
            **({"motor_colours": level.motor_colour, "thruster_colours": level.thruster_colour} if number % 2 else {}),
            "pixels_per_metre": SMALL,
        }
    return pictures
