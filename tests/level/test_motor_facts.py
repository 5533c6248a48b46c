"""Facts about motors and walls in docs/level_format.md, played."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jax2d.engine import Engine
from jax2d.scene import Controls
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.schema import level_from_json

ARM, NUM_STEPS = 4, 60  # slot of the arm; a second


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(SIZES["m"])  # whose program of a second others need too


def arm_document(power: float = 1.0) -> dict[str, Any]:
    """A bar of 0.6 m, level, hinged at its end to a fixed disc."""
    return {
        "format": "kinetix-dist-level", "version": 1, "name": "arm", "size": "m",
        "shapes": [
            {"id": "arm", "type": "box", "width": 0.6, "height": 0.1, "position": [2.8, 2.5], "role": "green"},
            {"id": "hub", "type": "circle", "radius": 0.1, "position": [2.5, 2.5], "fixed": True},
            {"id": "goal", "type": "circle", "radius": 0.1, "position": [1.0, 1.0], "role": "blue", "fixed": True},
        ],
        "joints": [
            {"type": "revolute", "a": "hub", "b": "arm", "anchor": [2.5, 2.5], "motor": {"speed": 3.0, "power": power}}
        ],
    }  # fmt: skip


def played(engine: Engine, document: dict[str, Any], action: float) -> tuple[float, float]:
    """Angle (rad) and angular velocity (rad/s) of the arm after a second of an action."""
    level = level_from_json(document)
    state = engine.initial_state(level.scene, level.position, level.angle, level.velocity, level.angular_velocity)
    # In a level the disc is b, not a: the speed has the other sign, and forward still means forward.
    controls = Controls(motor=np.full(2, action, np.float32), thruster=np.zeros(2, np.float32))
    state, _ = engine.step(level.scene, state, controls, num_steps=NUM_STEPS)
    return float(state.angle[ARM]), float(state.angular_velocity[ARM])


def test_power_is_900_rad_per_s2_times_the_inertia_of_the_two_shapes_alone(engine: Engine) -> None:
    """0.177 N m hold the bar; power 1 is 900 x 0.06 (0.6^2 + 0.1^2) / 12 = 1.67 N m, and 0.177 / 1.67 = 0.106."""
    for power, rises in ((0.10, False), (0.11, True)):
        angle, _ = played(engine, arm_document(power), 1.0)
        assert (angle > 0) == rises


def test_at_action_0_a_motor_turns_freely(engine: Engine) -> None:
    document = arm_document() | {"gravity": [0.0, 0.0]}
    document["shapes"][0] |= {"angular_velocity": 2.0, "velocity": [0.0, 0.6]}
    assert played(engine, document, 0.0)[1] == pytest.approx(2.0, abs=1e-3)


def test_a_motor_of_speed_0_brakes_at_either_action(engine: Engine) -> None:
    document = arm_document() | {"gravity": [0.0, 0.0]}
    document["shapes"][0] |= {"angular_velocity": 2.0, "velocity": [0.0, 0.6]}
    document["joints"][0]["motor"]["speed"] = 0.0
    for action in (1.0, -1.0):
        assert played(engine, document, action)[1] == pytest.approx(0.0, abs=1e-3)


def test_what_is_hinged_to_a_wall_passes_through_it(engine: Engine) -> None:
    """A bar of 0.6 m hinged 0.3 m above the floor would lie at -30 degrees if the floor stopped it."""
    document = arm_document()
    document["shapes"][0]["position"], document["shapes"][1]["position"] = [2.8, 0.7], [2.5, 0.7]
    document["joints"][0] |= {"anchor": [2.5, 0.7]}
    assert played(engine, document, 0.0)[0] > -0.6
    document["joints"][0]["a"], document["shapes"][1]["position"] = "floor", [0.5, 4.0]
    assert played(engine, document, 0.0)[0] < -1.0
