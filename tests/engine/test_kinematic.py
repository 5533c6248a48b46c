"""Kinematic bodies: they move as their velocity says, nothing pushes them, and what they touch goes with them."""

from __future__ import annotations

import math
from typing import Unpack

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Effects, Engine, MissingEffectError, SceneBuilder, SceneError, State, measure, preset
from jax2d.builder import BuiltWorld
from jax2d.builder_options import BodyKeywords, MaterialKeywords
from jax2d.fidelity import record_worlds
from tests.engine.worlds import CAPACITY, builder, engine, run

pytestmark = pytest.mark.also_gpu

G = 9.81
STANDARD = preset("standard")
H = STANDARD.substep_seconds
MU = STANDARD.base_friction  # of two shapes of friction 1


def platform(b: SceneBuilder, velocity: tuple[float, float], **options: Unpack[MaterialKeywords]) -> int:
    """Its top is y = 0."""
    return b.add_box(width=4, height=0.2, position=(0, -0.1), kinematic=True, velocity=velocity, **options)


# Formulas


def test_it_moves_as_its_velocity_says_through_whatever_stands_in_its_way():
    b = builder()
    lift = b.add_box(width=2, height=0.2, kinematic=True, velocity=(1.0, 0.5), angular_velocity=0.3)
    b.add_box(width=1, height=1, position=(1, 0), fixed=True)
    b.add_box(width=1, height=1, position=(0, 2), density=50)
    end = run(b.build(), 2.0)
    assert end.position[lift] == pytest.approx([2.0, 1.0], abs=1e-5)
    assert end.angle[lift] == pytest.approx(0.6, abs=1e-5)
    assert [*end.velocity[lift], end.angular_velocity[lift]] == pytest.approx([1.0, 0.5, 0.3], abs=0)


def test_box_on_a_platform_reaches_its_speed_by_friction():
    b = builder()
    floor, box = platform(b, (2.0, 0.0)), b.add_box(width=0.5, height=0.5, position=(0, 0.25))
    speeds: list[float] = []
    end = run(b.build(), 1.0, each_step=lambda state: speeds.append(state.velocity[box, 0]))
    assert speeds[9] == pytest.approx(MU * G * 10 / 60, rel=5e-3)  # the weight builds up in the first step
    assert next(i for i, speed in enumerate(speeds) if speed > 1.999) == pytest.approx(60 * 2 / (MU * G), abs=1.5)
    slipped = end.position[floor, 0] - end.position[box, 0]
    assert slipped == pytest.approx(2.0**2 / (2 * MU * G), rel=0.02)  # half a step of 1/60 s at 2 m/s is 1.7 %


def test_lift_raises_a_stack():
    b = builder()
    floor = platform(b, (0.0, 1.5))
    boxes = [b.add_box(width=0.5, height=0.5, position=(0, 0.25 + 0.5 * k)) for k in range(4)]
    end = run(b.build(), 3.0)
    for k, box in enumerate(boxes):
        assert end.position[box] - end.position[floor] == pytest.approx([0, 0.35 + 0.5 * k], abs=0.02)
        assert end.velocity[box] == pytest.approx([0, 1.5], abs=1e-4)


@pytest.mark.parametrize(("spin", "distance"), [(0.2, 2.0), (0.5, 4.0), (1.0, 3.0)])
def test_plank_that_tilts_carries_a_box_without_letting_it_slide(spin: float, distance: float):
    """Friction holds no position: velocities at the beginning or the end of a sub-step instead of in its middle would
    let the box creep by r w^2 h / 2 a second, 1.7 and 2.5 mm in the last two."""
    seconds = 0.4 / spin  # through 0.4 rad, less than atan(mu) = 0.51 in all
    b = builder()
    start = -0.2
    plank = b.add_box(width=12, height=0.2, position=(0, 0), kinematic=True, angular_velocity=spin, angle=start)
    c, s = math.cos(start), math.sin(start)
    at = np.array([c * distance - s * 0.3, s * distance + c * 0.3])
    velocity = (-spin * at[1], spin * at[0])
    box = b.add_box(width=0.4, height=0.4, angle=start, position=at, velocity=velocity, angular_velocity=spin)
    end = run(b.build(), seconds)
    c, s = math.cos(end.angle[plank]), math.sin(end.angle[plank])
    x, y = end.position[box] - end.position[plank]
    assert [c * x + s * y, c * y - s * x] == pytest.approx([distance, 0.3], abs=5e-4)
    assert end.angle[box] == pytest.approx(end.angle[plank], abs=1e-3)


def heights_above(world: BuiltWorld, ball: int, floor: int) -> np.ndarray:
    """[T] m, gap between a ball of 0.2 m and the top of a platform after each step."""
    found: list[float] = []
    run(world, 1.2, each_step=lambda state: found.append(state.position[ball, 1] - state.position[floor, 1] - 0.3))
    return np.array(found)


@pytest.mark.parametrize("restitution", [1.0, 0.5])
@pytest.mark.parametrize("speed", [-1.0, 0.0, 1.0, 3.0])
def test_ball_bounces_from_a_moving_platform_as_in_its_frame(speed: float, restitution: float):
    """The platform does work: the ball may leave with far more energy than it came with."""
    gap = 1.03
    b = builder()
    floor = platform(b, (0.0, speed), restitution=1.0)
    ball = b.add_circle(radius=0.2, position=(0, 0.2 + gap), restitution=restitution)
    above = heights_above(b.build(), ball, floor)
    rises = np.diff(above) > 0
    hit = int(np.argmax(rises & (np.cumsum(~rises) > 0)))  # the first time that it turns to rise
    falls_again = np.flatnonzero(np.diff(above[hit:]) < 0)
    apex = above[hit : hit + 1 + (int(falls_again[0]) if len(falls_again) else len(above))].max()
    energy = gap + (speed + G * H / 2) ** 2 / (2 * G)  # m, in the platform's frame, as semi-implicit Euler keeps it
    assert apex == pytest.approx(restitution**2 * energy, abs=0.01)


def test_motor_on_a_turning_body_turns_against_it():
    b = builder((0.0, 0.0))
    hub = b.add_circle(radius=0.2, kinematic=True, angular_velocity=2.0)
    arm = b.add_box(width=1, height=0.1)
    b.add_revolute_joint(hub, arm, at=(0, 0), motor_speed=0.5)
    assert run(b.build(), 2.0, motor=1.0).angular_velocity[arm] == pytest.approx(2.0 + 0.5 * 6, rel=1e-3)


def test_joint_hangs_a_body_from_a_lift():
    b = builder()
    lift = b.add_box(width=0.2, height=0.2, kinematic=True, velocity=(0.0, 1.0))
    rod = b.add_box(width=0.2, height=1, position=(0, -0.5))
    b.add_revolute_joint(lift, rod, at=(0, 0))
    world = b.build()
    gaps: list[float] = []
    end = run(world, 2.0, each_step=lambda state: gaps.append(float(np.max(measure.joint_gaps(world.scene, state)))))
    assert max(gaps) < 1e-3
    assert end.position[rod] == pytest.approx([0.0, 1.5], abs=1e-3)


# The frame of reference


def several_hit_a_platform(speed: float) -> BuiltWorld:
    """A ball after a ball, a disc with a load and a sliding box, seen from where the platform moves at `speed`, or is
    fixed."""
    b = builder()
    state: BodyKeywords = {"kinematic": True, "velocity": (0.3 * speed, speed)} if speed else {"fixed": True}
    b.add_box(width=8, height=0.2, position=(0, -0.1), restitution=0.9, **state)
    seen = (0.3 * speed, speed)

    def along(x: float, y: float) -> tuple[float, float]:
        return (x + seen[0], y + seen[1])

    for k in range(2):  # a light ball that follows a heavy one
        b.add_circle(
            radius=0.2, position=(-1, 0.8 + 0.5 * k), density=4 - 3 * k, restitution=0.9, velocity=along(0, -3)
        )
    disc = b.add_circle(radius=0.2, position=(1, 0.7), restitution=0.8, velocity=along(1, -4))
    load = b.add_box(width=0.2, height=0.2, position=(1, 1.1), velocity=along(1, -4), density=5)
    b.add_fixed_joint(disc, load, at=(1, 0.9))
    b.add_box(width=0.4, height=0.4, position=(-2.5, 0.2), velocity=along(3, 0))
    return b.build()


@pytest.mark.parametrize("speed", [2.0, -2.0, 5.0])
def test_a_world_with_a_platform_is_that_with_a_floor_seen_while_moving(speed: float):
    """So nothing that bounces, slides or is welded may notice what the platform does in the frame of the world: limits
    of energy, friction and margins. Until rounding grows."""
    seconds = 0.7
    still, moving = (run(several_hit_a_platform(v), seconds) for v in (0.0, speed))
    shift = np.array([0.3 * speed, speed])
    active = several_hit_a_platform(speed).scene.shapes.active
    np.testing.assert_allclose(moving.position[active] - shift * seconds, still.position[active], atol=2e-3)
    np.testing.assert_allclose(moving.angle[active], still.angle[active], atol=5e-3)


# Hard cases


def test_fast_kinematic_body_passes_nothing():
    """A wall of 10 cm runs into discs and boxes of its size; they must stay in front of it."""
    rng = np.random.default_rng(0)
    for speed in (5.0, 20.0, 60.0, 95.0):
        worlds = []
        for _ in range(16):
            b = builder((0.0, 0.0))
            start = -1 - rng.uniform(0, speed / 60)
            b.add_box(width=0.1, height=3, kinematic=True, velocity=(speed, 0), position=(start, 0))
            b.add_box(width=0.15, height=0.15, position=(0.5, rng.uniform(-1, 1)), angle=rng.uniform(0, 3))
            b.add_circle(radius=0.1, position=(0, rng.uniform(-1, 1)), velocity=(rng.uniform(-10, 0), 0))
            worlds.append(b.build())
        for one in record_worlds(engine(), worlds, seconds=0.3):
            x = one.position[:, :, 0]
            assert (x[:, 1] > x[:, 0] + 0.1).all() and (x[:, CAPACITY.polygons] > x[:, 0] + 0.13).all()


def test_turning_rod_passes_no_ball():
    rng = np.random.default_rng(1)
    for spin in (5.0, 20.0, 49.0):
        worlds = []
        for _ in range(24):
            b = builder((0.0, 0.0))
            at, distance = rng.uniform(0.2, math.pi - 0.2), rng.uniform(0.6, 1.3)
            b.add_box(width=3, height=0.1, kinematic=True, angular_velocity=spin)
            b.add_circle(radius=0.1, position=(distance * math.cos(at), distance * math.sin(at)))
            worlds.append(b.build())
        for one in record_worlds(engine(), worlds, seconds=0.5):
            d, angle = one.position[:, CAPACITY.polygons], one.angle[:, 0]
            along = np.cos(angle) * d[:, 0] + np.sin(angle) * d[:, 1]
            above = np.cos(angle) * d[:, 1] - np.sin(angle) * d[:, 0]
            beside = np.abs(along) < 1.4
            same_end = np.sign(along[1:]) == np.sign(along[:-1])
            assert not (beside[1:] & beside[:-1] & same_end & (np.sign(above[1:]) != np.sign(above[:-1]))).any()


@pytest.mark.parametrize("speed", [0.5, 2.0, 10.0])
def test_what_is_crushed_gives_way_and_does_not_explode(speed: float):
    """A press is stopped by no force: what it closes on leaves, at speeds of the order of its own."""
    b = builder((0.0, 0.0))
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    b.add_box(width=2, height=0.2, position=(0, 1.1), kinematic=True, velocity=(0, -speed))
    b.add_box(width=0.5, height=0.5, position=(0, 0.25))
    b.add_box(width=0.3, height=0.3, position=(-0.6, 0.15))
    b.add_circle(radius=0.2, position=(0.6, 0.2))
    fastest: list[float] = []
    end = run(b.build(), 3.0, each_step=lambda state: fastest.append(np.linalg.norm(state.velocity, axis=-1).max()))
    assert np.isfinite(end.position).all()
    assert max(fastest) < 3 * (speed + STANDARD.push_out_speed)


def test_velocity_can_be_set_between_steps():
    b = builder()
    floor, box = platform(b, (0.0, 0.0)), b.add_box(width=0.5, height=0.5, position=(0, 0.25))
    world, one = b.build(), engine()
    state = one.initial_state(*world)

    @jax.jit
    def shake(state: State) -> State:
        def step(state: State, i: jax.Array) -> tuple[State, None]:
            speed = 0.5 * jnp.cos(2 * math.pi * i / 60)
            state = jax.tree.map(lambda x: x, state)
            velocity = state.velocity.at[floor, 1].set(speed)
            return one.step(world.scene, State(**vars(state) | {"velocity": velocity}))[0], None

        return jax.lax.scan(step, state, jnp.arange(60))[0]

    end = shake(state)
    assert float(end.position[floor, 1]) == pytest.approx(-0.1, abs=1e-4)  # there and back
    assert float(end.position[box, 1] - end.position[floor, 1]) == pytest.approx(0.35, abs=0.01)


def test_speed_limits_act_and_are_counted():
    b = builder()
    floor = platform(b, (150.0, 0.0))
    state, touching = engine().step(b.build().scene, engine().initial_state(*b.build()))
    assert float(state.velocity[floor, 0]) == pytest.approx(100.0)
    assert int(touching.limited) == 1


# What is refused


def test_scene_with_a_kinematic_body_calls_for_the_effect():
    b = builder()
    platform(b, (0.0, 1.0))
    batch = jax.tree.map(lambda x: x[None], b.build().scene)
    without = Engine(CAPACITY, effects=Effects.full(CAPACITY).without("kinematic_bodies"))
    for one in (without, Engine(CAPACITY, settings=preset("paper"))):
        with pytest.raises(MissingEffectError, match="calls for kinematic_bodies"):
            one.pack_scene(batch)


def test_contradictions_are_refused():
    b = builder()
    with pytest.raises(SceneError, match="fixed or kinematic, not both"):
        b.add_circle(radius=1, fixed=True, kinematic=True)
    wall, lift = b.add_circle(radius=1, fixed=True), b.add_circle(radius=1, kinematic=True)
    with pytest.raises(SceneError, match="both fixed or kinematic, and which nothing can push"):
        b.add_revolute_joint(wall, lift, at=(0, 0))
    with pytest.raises(SceneError, match="thruster on shape 8, which is kinematic"):
        b.add_thruster(lift, at=(0, 0), angle=0.0)
    ball = b.add_circle(radius=1)
    world = b.build()
    kinematic = world.scene.shapes.kinematic.copy()
    kinematic[ball] = True
    heavy = world.scene.replace(shapes={"kinematic": kinematic})
    with pytest.raises(ValueError, match=r"scene\.shapes\.kinematic\[9\] is True; it must be False, or inverse_mass"):
        engine().step(heavy, engine().initial_state(*world))
