"""Where each quantity stands in the kernel's tables: the one place that both sides are generated from.

Scene, State and the rest are pytrees of small arrays; the kernel reads and writes four tables of
`[field, world]`, so that neighbouring threads touch neighbouring addresses. `Layout` gives each
quantity's first row; source.py turns the same numbers into C++ constants.
"""

from __future__ import annotations

import dataclasses

from jax2d.scene import Capacity

JOINT_FLAGS = {"JOINT_ACTIVE": 1, "JOINT_FIXED": 2, "JOINT_MOTOR": 4, "JOINT_LIMITED": 8}

PARAMS = (
    "DT",
    "H",
    "SUBSTEPS",
    "WARM_START",
    "BASE_FRICTION",
    "BASE_MOTOR_SPEED",
    "BASE_MOTOR_POWER",
    "BASE_THRUSTER_POWER",
    "MAX_SPEED",
    "MAX_OMEGA",
    "CONTACT_BIAS_RATE",
    "CONTACT_MASS_SCALE",
    "CONTACT_IMPULSE_SCALE",
    "FIXED_BIAS_RATE",
    "FIXED_MASS_SCALE",
    "FIXED_IMPULSE_SCALE",
    "JOINT_BIAS_RATE",
    "JOINT_MASS_SCALE",
    "JOINT_IMPULSE_SCALE",
    "PUSH_OUT_SPEED",
    "JOINT_PULL_SPEED",
    "JOINT_TURN_SPEED",
    "SPECULATIVE_DISTANCE",
    "RESTITUTION_THRESHOLD",
    "BOUNCE_ROUNDS",
    "SLOP",
    "COLLISION_CORRECTION",
    "JOINT_VELOCITY_CORRECTION",
    "JOINT_POSITION_CORRECTION",
    "JOINT_STIFFNESS",
    "FIXED_ANGLE_RATE",
    "LIMIT_ANGLE_RATE",
    "MOTOR_DECAY",
    "MOTOR_FADE_ANGLE",
)


@dataclasses.dataclass(frozen=True)
class Layout:
    """Rows of the kernel's tables for one capacity."""

    capacity: Capacity

    def rows(self) -> dict[str, dict[str, int]]:
        """First row of each quantity, by table; the key 'ROWS' gives the table's height."""
        c = self.capacity
        n, joints, thrusters = c.shapes, c.joints, c.thrusters
        return {
            "SCENE": _stack(
                INVERSE_MASS=n,
                INVERSE_INERTIA=n,
                FRICTION=n,
                RESTITUTION=n,
                VERTICES=2 * c.polygons * c.vertices,
                RADIUS=c.circles,
                ANCHOR_A=2 * joints,
                ANCHOR_B=2 * joints,
                REST_ANGLE=joints,
                MOTOR_SPEED=joints,
                MOTOR_POWER=joints,
                LOWER=joints,
                UPPER=joints,
                THRUSTER_POSITION=2 * thrusters,
                THRUSTER_ANGLE=thrusters,
                THRUSTER_POWER=thrusters,
                GRAVITY=2,
            ),
            "INTS": _stack(
                ACTIVE=c.touch_words,
                PARTNERS=n * c.touch_words,
                NUM_VERTICES=c.polygons,
                JOINTS=joints,
                THRUSTERS=thrusters,
            ),
            "STATE": _stack(POSITION=2 * n, ANGLE=n, VELOCITY=2 * n, OMEGA=n),
            "IMPULSE": _stack(JOINT=5 * joints, CONTACT=2 * c.contact_slots),
            "OUT": _stack(AT_END=n * c.touch_words, DURING=n * c.touch_words, OVERFLOW=1, LIMITED=1),
        }


def _stack(**heights: int) -> dict[str, int]:
    rows, total = {}, 0
    for name, height in heights.items():
        rows[name] = total
        total += height
    return rows | {"ROWS": total}
