"""A small level and rollouts of it whose motion is a formula: no engine needed to test recording and drawing."""

from __future__ import annotations

import json

import numpy as np

from jax2d.fields import empty
from jax2d.scene import Capacity, JointKind, Joints, Scene, Shapes, Springs, Thrusters
from kinetix_dist.level.level import Level, Role
from kinetix_dist.telemetry.recording import ActionName, Rollout

GRAVITY = 9.81
STEP_SECONDS = 1 / 30
CAPACITY = Capacity(polygons=5, circles=3, joints=2, thrusters=2)
# Shapes: polygons 0-4, circles 5-7
FLOOR, GREEN_BOX, BLUE_BOX, GREY_TRIANGLE, RED_BLOCK, GREY_BALL, SPARE_BALL = 0, 1, 2, 3, 4, 5, 6
START = np.array([[2.5, -0.3], [1.0, 3.0], [3.0, 2.0], [4.2, 1.5], [2.0, 0.8], [1.0, 1.8], [0, 0], [0, 0]], np.float32)


def rectangle(width: float, height: float) -> list[list[float]]:
    x, y = width / 2, height / 2
    return [[-x, -y], [x, -y], [x, y], [-x, y]]


def scene() -> Scene:
    """Floor, a green box with a thruster, a blue box hinged (motor) to a grey ball, a triangle, a fixed red block."""
    n, joints, thrusters = CAPACITY.shapes, CAPACITY.joints, CAPACITY.thrusters
    triangle = [[-0.3, -0.2], [0.3, -0.2], [0.0, 0.4], [0.0, 0.4]]
    inverse_mass = np.array([0, 1, 1, 1, 0, 1, 0, 0], np.float32)
    return Scene(
        shapes=Shapes(
            active=np.array([1, 1, 1, 1, 1, 1, 0, 0], bool),
            inverse_mass=inverse_mass,
            inverse_inertia=inverse_mass,
            density=np.ones(n, np.float32),
            kinematic=np.zeros(n, bool),
            friction=np.ones(n, np.float32),
            restitution=np.zeros(n, np.float32),
            vertices=np.array(
                [rectangle(5, 1), rectangle(0.8, 0.6), rectangle(1, 0.5), triangle, rectangle(0.6, 0.6)], np.float32
            ),
            num_vertices=np.array([4, 4, 4, 3, 4], np.int32),
            radius=np.array([0.35, 0, 0], np.float32),
            can_touch=~np.eye(n, dtype=bool),
            **dict.fromkeys(
                ("surface_speed", "linear_damping", "angular_damping", "rolling_resistance"), np.zeros(0, np.float32)
            ),
        ),
        joints=Joints(
            active=np.array([True, False]),
            a=np.array([BLUE_BOX, 0], np.int32),
            b=np.array([GREY_BALL, 0], np.int32),
            anchor_a=np.array([[-0.4, 0.0], [0, 0]], np.float32),
            anchor_b=np.zeros((joints, 2), np.float32),
            kind=np.where(np.zeros(joints, bool), JointKind.FIXED, JointKind.REVOLUTE).astype(np.int32),
            rest_angle=np.zeros(joints, np.float32),
            axis_angle=np.zeros(joints, np.float32),
            motor_on=np.array([True, False]),
            drive=np.zeros(joints, np.int32),
            motor_speed=np.ones(joints, np.float32),
            motor_power=np.ones(joints, np.float32),
            has_limits=np.zeros(joints, bool),
            lower_limit=np.zeros(joints, np.float32),
            upper_limit=np.zeros(joints, np.float32),
        ),
        springs=empty(Springs, CAPACITY.sizes),
        thrusters=Thrusters(
            active=np.array([True, False]),
            body=np.array([GREEN_BOX, 0], np.int32),
            position=np.array([[0.0, -0.3], [0, 0]], np.float32),
            angle=np.full(thrusters, np.pi / 2, np.float32),
            power=np.ones(thrusters, np.float32),
        ),
        gravity=np.array([0, -GRAVITY], np.float32),
    )


def level() -> Level:
    n = CAPACITY.shapes
    roles = [Role.NONE, Role.GREEN, Role.BLUE, Role.NONE, Role.RED, Role.NONE, Role.NONE, Role.NONE]
    return Level(
        scene=scene(),
        position=START,
        angle=np.zeros(n, np.float32),
        velocity=np.zeros((n, 2), np.float32),
        angular_velocity=np.zeros(n, np.float32),
        shape_role=np.array(roles, np.int32),
        collision_mode=np.ones(n, np.int32),
        motor_colour=np.zeros(CAPACITY.joints, np.int32),
        motor_auto=np.zeros(CAPACITY.joints, bool),
        thruster_colour=np.zeros(CAPACITY.thrusters, np.int32),
    )


LEVEL_JSON = json.dumps({"name": "falling", "made_by": "tests/telemetry/worlds.py"})


def decode_level(text: str) -> Level:
    """The level that LEVEL_JSON stands for."""
    if json.loads(text)["name"] != "falling":
        raise ValueError(f"unknown level {text}")
    return level()


def falling_rollout(num_steps: int = 20, seed: int = 0, *, solved: bool = True, failed: bool = False) -> Rollout:
    """The triangle falls freely and turns by one radian a second; the thruster fires in every second step."""
    rng = np.random.default_rng(seed)
    n, time = CAPACITY.shapes, np.arange(num_steps + 1, dtype=np.float32) * np.float32(STEP_SECONDS)
    position = np.tile(START, (num_steps + 1, 1, 1))
    velocity = np.zeros_like(position)
    angle = np.zeros((num_steps + 1, n), np.float32)
    position[:, GREY_TRIANGLE, 1] -= GRAVITY * time**2 / 2
    velocity[:, GREY_TRIANGLE, 1] = -GRAVITY * time
    angle[:, GREY_TRIANGLE] = time
    actions = rng.integers(0, 2, (num_steps, 6)).astype(np.float32)
    motor = np.zeros((num_steps, CAPACITY.joints), np.float32)
    motor[:, 0] = np.where(actions[:, 0] == 1, 1.0, 0.0)
    thruster = np.zeros((num_steps, CAPACITY.thrusters), np.float32)
    thruster[1::2, 0] = 1.0
    reward = rng.normal(size=num_steps).astype(np.float32)
    return Rollout(
        level=level(),
        level_json=LEVEL_JSON,
        level_name=f"falling {seed}",
        position=position,
        angle=angle,
        velocity=velocity,
        angular_velocity=np.ones_like(angle),
        actions=actions,
        motor=motor,
        thruster=thruster,
        reward=reward,
        solved=solved,
        failed=failed,
        policy_version=3,
        seed=seed,
        step_seconds=STEP_SECONDS,
        action_names=tuple(ActionName(f"motor colour {k}", ("off", "forward")) for k in range(6)),
    )
