"""The prismatic joint: motions with a formula, hard cases, the reference, and engines compiled without it."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

from jax2d import (
    BuiltWorld,
    Capacity,
    Effects,
    Engine,
    MissingEffectError,
    Scene,
    SceneBuilder,
    measure,
    preset,
)
from jax2d.scene import JointKind
from tests.engine.worlds import CAPACITY, builder, engine, run

pytestmark = pytest.mark.also_gpu

G = 9.81
STANDARD = preset("standard")
H = STANDARD.substep_seconds


def turn_difference(state, a: int, b: int) -> float:
    return float(state.angle[b] - state.angle[a])


def rail(gravity: tuple[float, float] = (0.0, -G)) -> tuple[SceneBuilder, int]:
    b = builder(gravity)
    return b, b.add_box(width=1, height=0.2, fixed=True)


# Formulas


@pytest.mark.parametrize("slope", [0.1, math.pi / 6, 1.2, -0.7])
def test_body_on_a_rail_accelerates_by_g_sin_of_its_slope(slope):
    b, base = rail()
    box = b.add_box(width=0.4, height=0.2, angle=0.3, position=(0.1, 0.0))
    b.add_prismatic_joint(base, box, at=(0.1, 0.0), axis_angle=-slope)
    world = b.build()
    end = run(world, 1.0)
    travel = end.position[box] - world.position[box]
    direction = np.array([math.cos(slope), -math.sin(slope)])
    # Semi-implicit Euler slides g sin(slope) t h / 2 farther.
    assert travel @ direction == pytest.approx(G * math.sin(slope) * (1 + H) / 2, rel=1e-4)
    assert abs(travel @ [-direction[1], direction[0]]) < 1e-4
    assert end.angle[box] == pytest.approx(0.3, abs=1e-5)


def test_bead_on_a_turning_rod_moves_out_as_the_hyperbolic_cosine():
    b = builder((0.0, 0.0))
    rod = b.add_box(width=2, height=2, density=1e5, angular_velocity=1.5)
    bead = b.add_circle(radius=0.1, position=(0.5, 0.0), velocity=(0.0, 0.75), angular_velocity=1.5)
    b.add_prismatic_joint(rod, bead, at=(0.5, 0.0), axis_angle=0.0)
    end = run(b.build(), 1.0)
    away = np.linalg.norm(end.position[bead] - end.position[rod])
    assert away == pytest.approx(0.5 * math.cosh(1.5), rel=0.01)
    assert math.remainder(math.atan2(*(end.position[bead] - end.position[rod])[::-1]) - 1.5, math.tau) == pytest.approx(
        0.0, abs=0.01
    )


def test_motor_pushes_with_its_force_and_keeps_its_speed():
    b, base = rail()
    lift = b.add_box(width=0.5, height=0.4, position=(0, 0.5), density=3)
    b.add_prismatic_joint(base, lift, at=(0, 0.5), axis_angle=math.pi / 2, motor_speed=0.5, motor_power=0.4)
    world = b.build()
    speeds = []
    end = run(world, 1.0, motor=1.0, each_step=lambda state: speeds.append(state.velocity[lift, 1]))
    # The force is in units of the mass that it moves.
    assert speeds[0] == pytest.approx((0.4 * STANDARD.base_slider_power - G) * STANDARD.dt, rel=1e-4)
    assert end.velocity[lift, 1] == pytest.approx(0.5 * STANDARD.base_slider_speed, rel=1e-4)
    assert max(speeds) <= 0.5 * STANDARD.base_slider_speed * (1 + 1e-5)


@pytest.mark.parametrize("control", [-1.0, 0.5])
def test_control_sets_direction_and_share_of_the_speed(control):
    b, base = rail((0.0, 0.0))
    box = b.add_box(width=0.5, height=0.4, position=(1, 0))
    b.add_prismatic_joint(base, box, at=(1, 0), axis_angle=0.0, motor_speed=1.0, motor_power=1.0)
    end = run(b.build(), 0.5, motor=control)
    assert end.velocity[box, 0] == pytest.approx(control * STANDARD.base_slider_speed, rel=1e-4)


def test_motor_weaker_than_the_weight_lowers_it_with_what_is_left():
    b, base = rail()
    box = b.add_box(width=0.5, height=0.4, position=(0, 3))
    power = 0.6 * G / STANDARD.base_slider_power
    b.add_prismatic_joint(base, box, at=(0, 3), axis_angle=math.pi / 2, motor_speed=1.0, motor_power=power)
    end = run(b.build(), 0.5, motor=1.0)
    assert end.velocity[box, 1] == pytest.approx(-0.4 * G * 0.5, rel=1e-3)


def test_limits_stop_it_both_ways_without_a_bounce():
    for motor, where in ((1.0, 1.7), (-1.0, 0.3)):
        b, base = rail((0.0, 0.0))
        box = b.add_box(width=0.3, height=0.3, position=(1, 0), velocity=(5.0 * motor, 0.0))
        b.add_prismatic_joint(base, box, at=(1, 0), axis_angle=0.0, motor_speed=1.0, limits=(-0.7, 0.7))
        reached = []
        end = run(
            b.build(), 1.0, motor=motor, each_step=lambda state, box=box, to=reached: to.append(state.position[box, 0])
        )
        assert end.position[box, 0] == pytest.approx(where, abs=2e-3)
        assert np.abs(np.array(reached) - 1.0).max() < 0.7 + 2e-3


@pytest.mark.parametrize("motor", [0.0, 1.0])
def test_free_pair_keeps_momentum_and_angular_momentum(motor):
    b = builder((0.0, 0.0))
    a = b.add_box(width=1, height=0.2, velocity=(1.0, 0), angular_velocity=3.0)
    c = b.add_circle(radius=0.3, position=(0.4, 0.3), velocity=(-0.5, 2.0))
    b.add_prismatic_joint(a, c, at=(0.4, 0.3), axis_angle=0.5, motor_speed=1.0, motor_power=0.3, limits=(-0.3, 0.3))
    world = b.build()
    start = engine().initial_state(*world)
    end = run(world, 1.0, motor=motor)
    np.testing.assert_allclose(measure.momentum(world.scene, end), measure.momentum(world.scene, start), atol=2e-5)
    before, after = (float(measure.angular_momentum(world.scene, state)) for state in (start, end))
    # The limit takes up its overlap with the anchors apart, which a lever along the axis would turn the pair by.
    assert after == pytest.approx(before, abs=1e-5 + 1e-3 * abs(before))
    assert abs(turn_difference(end, a, c)) < 2e-3


# The two ends


def swapped(world: BuiltWorld, joint: int = 0) -> BuiltWorld:
    """The same slider named from its other end: the axis in b's frame, towards a."""
    joints = world.scene.joints
    axis = joints.axis_angle.copy()
    rest = joints.rest_angle.copy()
    axis[joint] += math.pi - rest[joint]
    rest[joint] = -rest[joint]
    values = {name: getattr(joints, name).copy() for name in ("a", "b", "anchor_a", "anchor_b")}
    for one, other in (("a", "b"), ("anchor_a", "anchor_b")):
        values[one][joint], values[other][joint] = getattr(joints, other)[joint], getattr(joints, one)[joint]
    return world._replace(scene=world.scene.replace(joints=values | {"axis_angle": axis, "rest_angle": rest}))


def test_slider_named_from_its_other_end_moves_alike():
    b = builder()
    a = b.add_box(width=1, height=0.3, angle=0.4, velocity=(0, 3), angular_velocity=0.5)
    c = b.add_box(width=0.3, height=0.5, angle=-0.8, position=(0.6, 0.2), density=2)
    b.add_prismatic_joint(a, c, at=(0.5, 0.1), axis_angle=0.9, motor_speed=0.7, motor_power=0.5, limits=(-0.1, 0.4))
    world = b.build()
    one, other = run(world, 0.7, motor=1.0), run(swapped(world), 0.7, motor=1.0)
    np.testing.assert_allclose(one.position, other.position, atol=1e-4)
    np.testing.assert_allclose(one.angle, other.angle, atol=1e-4)
    assert np.linalg.norm(one.position[c] - one.position[a]) > 0.3  # the motor has moved it


# Hard cases


def test_load_beside_the_rail_does_not_turn_it():
    b, base = rail()
    cart = b.add_box(width=0.2, height=0.2, position=(1, 0))
    weight = b.add_box(width=0.5, height=0.5, position=(3, 0), density=0.1)
    b.add_prismatic_joint(
        base, cart, at=(1, 0), axis_angle=math.pi / 2, motor_speed=1.0, motor_power=1.0, limits=(-0.5, 0.5)
    )
    b.add_fixed_joint(cart, weight, at=(2, 0))
    end = run(b.build(), 6.0)  # the lever rings: 17 mm/s after 3 s, where welds solved point after angle left 6
    assert end.position[cart] == pytest.approx([1.0, -0.5], abs=1e-3)
    assert abs(turn_difference(end, base, cart)) < 0.02
    assert np.abs(end.velocity).max() < 0.01


def test_press_between_two_walls_neither_sinks_nor_blows_up():
    """The force is that of 100 g on the press, which has eight times the mass of the box before the wall."""
    b = builder((0.0, 0.0))
    wall = b.add_box(width=0.2, height=2, fixed=True, position=(1.0, 0))
    base = b.add_box(width=0.2, height=2, fixed=True, position=(-2.0, 0))
    press = b.add_box(width=0.5, height=0.5, position=(-1.0, 0), density=3)
    box = b.add_box(width=0.3, height=0.3, position=(0.0, 0.05), density=1)
    b.add_prismatic_joint(base, press, at=(-1.0, 0), axis_angle=0.0, motor_speed=1.0, motor_power=1.0)
    world = b.build()
    depths, speeds = [], []

    def look(state):
        depths.append(float(measure.overlaps(world.scene, state.position, state.angle).max()))
        speeds.append(float(np.abs(state.velocity).max()))

    end = run(world, 3.0, motor=1.0, each_step=look)
    assert end.position[box, 0] < 1.0 and wall == 0  # it has not been pressed through
    assert np.isfinite(end.position).all()
    assert max(speeds) < 1.5 * STANDARD.base_slider_speed
    assert np.median(speeds[-30:]) < 0.05
    assert np.median(depths[-30:]) < 0.05


# Twice the mass on half of it: known to tremble, of hinges ten times as much.
@pytest.mark.parametrize(("ratio", "max_gap", "max_speed"), [(1.0, 0.005, 1e-3), (2.0, 0.015, 0.3)])
def test_telescope_of_stages_holds_and_gains_no_energy(ratio, max_gap, max_speed):
    b = builder()
    previous = b.add_box(width=0.2, height=0.4, fixed=True, position=(0, 5))
    for i in range(3):
        stage = b.add_box(width=0.2, height=0.4, position=(0.25 * (i + 1), 5), density=ratio**i)
        b.add_prismatic_joint(previous, stage, at=(0.25 * i, 5), axis_angle=-1.0, limits=(-0.2, 0.2))
        previous = stage
    world = b.build()
    gaps, energies = [], [float(measure.energy(world.scene, engine().initial_state(*world)))]

    def look(state):
        gaps.append(float(np.max(measure.joint_gaps(world.scene, state))))
        energies.append(float(measure.energy(world.scene, state)))

    end = run(world, 5.0, each_step=look)
    assert max(gaps) < max_gap
    assert max(energies) <= energies[0] + 0.05
    assert np.abs(end.velocity).max() < max_speed  # at rest in the limits
    assert np.abs(end.angle).max() < 0.1


def test_fast_pair_in_flight_stays_together():
    b = builder((0.0, 0.0))
    a = b.add_box(width=1, height=0.2, angular_velocity=30.0)
    c = b.add_box(width=0.2, height=0.2, position=(0.3, 0.0), velocity=(0, 9.0), angular_velocity=30.0)
    b.add_prismatic_joint(a, c, at=(0.3, 0.0), axis_angle=0.0, limits=(-0.6, 0.2))
    world = b.build()
    energies, gaps = [float(measure.kinetic_energy(world.scene, engine().initial_state(*world)))], []

    def look(state):
        energies.append(float(measure.kinetic_energy(world.scene, state)))
        gaps.append(float(np.max(measure.joint_gaps(world.scene, state))))

    run(world, 2.0, each_step=look)
    assert max(gaps) < 0.05
    assert max(energies) <= energies[0] * 1.02


# Effects


def all_kinds(capacity: Capacity = CAPACITY) -> BuiltWorld:
    b = SceneBuilder(capacity)
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    a = b.add_box(width=0.8, height=0.3, position=(0, 1.0), angle=0.2)
    c = b.add_box(width=0.3, height=0.3, position=(0.5, 1.2), angle=-0.5)
    d = b.add_circle(radius=0.2, position=(-0.5, 0.8))
    e = b.add_box(width=0.2, height=0.4, position=(0.9, 1.3))
    b.add_prismatic_joint(a, c, at=(0.5, 1.1), axis_angle=0.7, motor_speed=-0.6, motor_power=0.7, limits=(-0.3, 0.2))
    b.add_revolute_joint(a, d, at=(-0.4, 0.9), motor_speed=1.0)
    b.add_fixed_joint(c, e, at=(0.7, 1.25))
    return b.build()


def batched(scene: Scene) -> Scene:
    return jax.tree.map(lambda x: x[None], scene)


def test_scene_with_a_slider_calls_for_the_effect_and_an_engine_without_refuses_it():
    world = all_kinds()
    without = Engine(CAPACITY, effects=Effects.full(CAPACITY).without("prismatic_joints"))
    with pytest.raises(MissingEffectError, match="prismatic_joints"):
        without.pack_scene(batched(world.scene))
    slider_free = world.scene.replace(joints={"active": world.scene.joints.kind != JointKind.PRISMATIC})
    without.pack_scene(batched(slider_free))


def test_solver_of_the_paper_refuses_a_slider():
    with pytest.raises(MissingEffectError, match="prismatic_joints"):
        Engine(CAPACITY, settings=preset("paper")).pack_scene(batched(all_kinds().scene))
