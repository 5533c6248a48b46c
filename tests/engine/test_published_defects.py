"""Defects of the published Jax2D engine (1.0.2), each as a test that preset `standard` passes.

The figures in the docstrings are the published engine's, measured on the same scenes.
"""

from __future__ import annotations

import dataclasses
import math
import time

import jax
import numpy as np
import pytest

from jax2d import Engine, SceneBuilder, State, measure, stack_worlds
from jax2d.fidelity import Trajectory, record_worlds
from jax2d.fidelity.hard_scenes import CAPACITY as LARGE
from jax2d.fidelity.hard_scenes import HardSceneBuilder
from jax2d.fidelity.hard_scenes.chains import cantilever
from kinetix_dist.level.level import SIZES
from tests.engine.worlds import CAPACITY, builder, engine, run

G = 9.81
FIRST_CIRCLE = CAPACITY.polygons


def trajectory_of(b: SceneBuilder, seconds: float) -> Trajectory:
    return record_worlds(engine(), [b.build()], seconds=seconds)[0]


def floor(b: SceneBuilder, **options: object) -> int:
    return b.add_box(width=40, height=1, position=(0, -0.5), fixed=True, **options)  # type: ignore[arg-type]


# Masses


def test_disc_inertia_is_half_m_r_squared():
    """Half of it: discs roll at 0.795 g sin a instead of 2/3."""
    b = builder()
    disc = b.add_circle(radius=0.3, density=2)
    mass = 2 * math.pi * 0.3**2
    assert 1 / b.build().scene.shapes.inverse_inertia[disc] == pytest.approx(mass * 0.3**2 / 2, rel=1e-5)


def test_triangle_inertia_does_not_depend_on_where_it_was_drawn():
    """Factors of 0.667, 1.06 and 18 for the same triangle."""
    triangle = np.array([(0, 0), (1, 0), (0.2, 0.7)])
    b = builder()
    for offset in ((0, 0), (-0.4, -0.2), (5, 3)):
        b.add_polygon([*(triangle + offset)])
    sides = np.roll(triangle, -1, axis=0) - triangle
    inertia = 0.35 * np.square(sides).sum() / 36  # area (a^2 + b^2 + c^2) / 36
    assert 1 / b.build().scene.shapes.inverse_inertia[:3] == pytest.approx(inertia, rel=1e-4)


def test_centre_of_mass_is_the_area_centroid():
    """The mean of the vertices, which for this quadrilateral lies 0.17 m lower."""
    b = builder()
    quad = b.add_polygon([(-1, 0), (1, 0), (0.1, 1), (-0.1, 1)])
    height = (2 + 2 * 0.2) / (3 * (2 + 0.2))  # of a trapezium's centroid above its longer side
    assert b.build().position[quad] == pytest.approx([0, height], abs=1e-6)


# Manifolds


def tilted(b: SceneBuilder, *, left: float, right: float, friction: float = 0.0) -> int:
    """A box of 1 m whose lower corners stand at these heights over a floor."""
    angle = math.asin(right - left)
    middle = (left + right) / 2
    return b.add_box(
        width=1,
        height=1,
        position=(-0.5 * math.sin(angle), middle + 0.5 * math.cos(angle)),
        angle=angle,
        friction=friction,
    )


def test_each_point_of_a_manifold_has_its_own_depth():
    """The published engine gives both the deepest: the corner that only touches is pushed out as hard, and the box
    never levels."""
    b = builder()
    floor(b)
    box = tilted(b, left=-0.02, right=-0.002)
    m = trajectory_of(b, 1.0)
    right_corner = m.position[:, box, 1] - 0.5 * np.cos(m.angle[:, box]) + 0.5 * np.sin(m.angle[:, box])
    assert right_corner.max() < 0.002
    assert abs(m.angle[-1, box]) < 0.02 * abs(m.angle[0, box])


def test_a_corner_that_does_not_penetrate_yet_is_a_contact_already():
    """The published engine finds none: a box rocks from corner to corner before it rests."""
    b = builder()
    floor(b)
    tilted(b, left=-0.001, right=0.004)
    end = run(b.build(), 1 / 60)
    assert (end.contact_key >= 0).sum() == 2


def test_clipped_point_has_the_depth_at_which_it_was_clipped():
    """The published engine's point has the depth of the corner it was clipped from: a plank is thrown off a post that
    it hardly overlaps, and the post's other edge is no contact, since the plank's other end is above it."""
    b = builder(gravity=(0, 0))
    b.add_box(width=0.2, height=1, position=(0, -0.5), fixed=True)
    for k in range(3):  # polygon slots 0 to 3 of the published package never collide with each other
        b.add_box(width=1, height=1, position=(100 + 3 * k, 0), fixed=True)
    depth, tilt = 0.008, 0.0045  # the plank's corner, beside the post, is deeper by 1.9 m x 0.0045
    plank = b.add_box(width=4, height=0.1, angle=tilt, position=(0, 0.05 - depth + 0.1 * tilt))
    assert (run(b.build(), 1 / 60).contact_key >= 0).sum() == 2
    m = trajectory_of(b, 1.0)
    assert m.speed().max() < 0.01  # thrown at 0.08 m/s
    assert m.position[-1, plank, 1] < 0.05 + 0.1 * tilt + 0.001


def test_remembered_impulses_stay_with_their_feature():
    """Points are matched by order of depth, so that a resting box that tips a little exchanges the impulses of its
    corners."""
    b = builder()
    floor(b)
    b.add_polygon([(-0.5, 0), (0.5, 0), (0.5, 0.3), (-0.5, 1)])
    world = b.build()
    at_rest = run(world, 2.0)
    keys, before = by_feature(at_rest)
    assert before[0] > 1.3 * before[1] or before[1] > 1.3 * before[0]  # it is heavier on the left
    for tip in (-5e-4, 5e-4):
        angle = at_rest.angle.copy()
        angle[1] += tip
        after, _ = engine().step(world.scene, dataclasses.replace(at_rest, angle=angle))
        keys_after, impulses_after = by_feature(after)
        assert (keys_after == keys).all()
        assert impulses_after == pytest.approx(before, rel=0.25)


def by_feature(state: State) -> tuple[np.ndarray, np.ndarray]:
    """Keys and normal impulses of the two contacts, by their features; the engine has the deeper one last."""
    keys, impulses = np.asarray(state.contact_key[:2]), np.asarray(state.contact_impulse[:2, 0])
    return np.sort(keys), impulses[np.argsort(keys)]


# Contacts


@pytest.mark.parametrize(("restitution", "height"), [(1.0, 1.0), (0.5, 0.25)])
def test_bounce_gains_nothing_from_the_push_out(restitution: float, height: float):
    """e = 1 from 1 m peaks at 1.19, 1.43 ... 6.27 m within 10 s; e = 0.5 gives 0.318 m."""
    b = builder()
    floor(b, restitution=restitution)
    ball = b.add_circle(radius=0.1, position=(0, 1.1), restitution=restitution)
    m = trajectory_of(b, 10.0)
    risen = m.position[:, ball, 1] - 0.1
    first = int(np.argmax(np.diff(m.velocity[:, ball, 1]) > 0)) + 1
    assert risen[first:].max() == pytest.approx(height, abs=0.015)


def test_frictionless_floor_takes_no_speed():
    """mu = sqrt(mu_a^2 + mu_b^2) is never zero while one body has friction."""
    b = builder()
    floor(b, friction=0.0)
    box = b.add_box(width=0.5, height=0.5, position=(0, 0.25), velocity=(2, 0), friction=1.0)
    m = trajectory_of(b, 2.0)
    assert m.position[-1, box, 1] == pytest.approx(0.25, abs=0.02)
    assert m.velocity[-1, box, 0] == pytest.approx(2.0, abs=1e-4)


def test_deep_overlap_is_undone_without_a_throw():
    """0.6 m of overlap throws two boxes apart at 3.5 m/s, which they keep."""
    b = builder(gravity=(0, 0))
    boxes = [b.add_box(width=1, height=1, position=(x, 0)) for x in (-0.2, 0.2)]
    m = trajectory_of(b, 2.0)
    assert m.depth() < 0.01
    assert m.speed().max() < 0.5  # the push itself is taken back within its sub-step
    assert np.linalg.norm(m.velocity[-1, boxes], axis=-1).max() < 0.25


def test_coincident_circles_come_apart():
    """The published engine leaves them together for ever."""
    b = builder(gravity=(0, 0))
    one, two = b.add_circle(radius=0.3), b.add_circle(radius=0.3)
    m = trajectory_of(b, 2.0)
    assert np.linalg.norm(m.position[-1, one] - m.position[-1, two]) > 0.59


@pytest.mark.parametrize("x", [0.3, 0.45, 0.5])
def test_circle_centred_inside_a_polygon_leaves_by_the_nearest_face(x: float):
    """Wrong depth inside, no normal at all on the edge."""
    b = builder(gravity=(0, 0))
    b.add_box(width=1, height=1, fixed=True)
    ball = b.add_circle(radius=0.2, position=(x, 0.05))
    m = trajectory_of(b, 2.0)
    assert m.position[-1, ball] == pytest.approx([0.7, 0.05], abs=0.01)


@pytest.mark.parametrize("speed", [10.0, 15.0, 20.0, 90.0])
def test_ball_does_not_tunnel_through_a_thin_wall(speed: float):
    """The published engine lets 12 % of 64 phases pass at 10 m/s, 50 % at 15 to 20, 88 % at 90."""
    worlds = []
    for phase in range(64):
        b = builder(gravity=(0, 0))
        b.add_box(width=0.1, height=4, fixed=True)
        b.add_circle(radius=0.1, position=(-3 - speed / 60 * phase / 64, 0), velocity=(speed, 0))
        worlds.append(b.build())
    for m in record_worlds(engine(), worlds, seconds=1.0):
        assert m.position[:, FIRST_CIRCLE, 0].max() < 0


def test_box_of_thirty_times_the_mass_rests_on_a_light_one():
    """The light box is shot out."""
    b = builder()
    floor(b)
    light = b.add_box(width=1, height=1, position=(0, 0.5))
    heavy = b.add_box(width=1, height=1, position=(0, 1.5), density=30)
    m = trajectory_of(b, 10.0)
    assert m.position[-1, light] == pytest.approx([0, 0.5], abs=0.01)
    assert m.position[-1, heavy] == pytest.approx([0, 1.5], abs=0.02)


# Joints and motors


def test_two_jointed_bodies_keep_their_angular_momentum():
    """23 % is lost in 10 s."""
    b = builder(gravity=(0, 0))
    left = b.add_box(width=1, height=0.4, angular_velocity=3.0)
    right = b.add_box(width=1, height=0.2, position=(1, 0), velocity=(0, 3.0), angular_velocity=3.0)
    b.add_revolute_joint(left, right, at=(0.5, 0))
    scene = b.build().scene
    seen: list[State] = []
    run(b.build(), 10.0, each_step=seen.append)
    first, last = (float(measure.angular_momentum(scene, s)) for s in (seen[0], seen[-1]))
    assert last == pytest.approx(first, rel=0.01)


@pytest.mark.parametrize(("links", "seconds", "lost"), [(1, 20.0, 0.05), (2, 10.0, 0.05)])
def test_pendulum_keeps_its_swing(links: int, seconds: float, lost: float):
    """A pendulum loses 26 % of its energy in 20 s, a double pendulum 32 % in 10 s."""
    b = builder()
    last = b.add_circle(radius=0.05, fixed=True)
    for k in range(links):
        bob = b.add_circle(radius=0.2, position=(0.7 * (k + 1), -0.7 * (k + 1)))
        b.add_revolute_joint(last, bob, at=(0.7 * k, -0.7 * k))
        last = bob
    m = trajectory_of(b, seconds)
    depth = 0.3 * sum(range(1, links + 1))  # m, a good part of what the bobs fall together
    weight = G * math.pi * 0.2**2
    gained = m.energy() - m.energy()[0]
    assert gained[-60:].min() > -lost * weight * depth
    assert gained.max() < lost * weight * depth


@pytest.mark.parametrize("ratio", [47.0, 157.0])
def test_heavy_ball_on_a_chain_hangs_still(ratio: float):
    """The published engine's ball swings by metres at 47 times the mass of a link, and explodes at 157 times."""
    b = HardSceneBuilder(floor=False)
    last = b.circle(0, 0, radius=0.1, fixed=True)
    for k in range(6):
        link = b.box(0, -0.5 - k, width=0.25)
        b.revolute(last, link, 0, -k)
        last = link
    ball = b.circle(0, -7, radius=1.0, density=ratio * 0.25 / math.pi)
    b.revolute(last, ball, 0, -6)
    (m,) = record_worlds(Engine(LARGE), [b.builder.build()], seconds=10.0)
    assert np.abs(m.position[:, ball, 0]).max() < 0.01
    assert m.joint_gaps().max() < 0.1


@pytest.mark.parametrize("power", [0.5, 4 / 3, 5.0, 100.0])
def test_motor_of_any_power_runs_steadily(power: float):
    """A velocity gain: above power 4/3 the speed alternates for ever."""
    b = builder(gravity=(0, 0))
    post = b.add_circle(radius=0.1, fixed=True)
    wheel = b.add_circle(radius=0.3)
    b.add_revolute_joint(post, wheel, at=(0, 0), motor_speed=1.0, motor_power=power)
    m = trajectory_of(b, 3.0)
    late = m.angular_velocity[m.index_at(2.0) :, wheel]
    assert late == pytest.approx(6.0, rel=0.01)


def test_welded_cantilever_comes_to_rest():
    """The published engine's cantilever never settles."""
    (m,) = record_worlds(Engine(LARGE), [cantilever().world], seconds=20.0)
    fastest = [m.speed()[m.index_at(t) : m.index_at(t + 5)].max() for t in (0, 5, 10, 15)]
    assert max(fastest[1:]) < 1e-4
    assert m.joint_gaps().max() < 0.01


def test_limit_stops_an_arm_without_a_jump():
    """The angle jumps back to the limit within a step."""
    b = builder()
    post = b.add_circle(radius=0.05, fixed=True)
    arm = b.add_box(width=1, height=0.1, position=(0.5, 0))
    b.add_revolute_joint(post, arm, at=(0, 0), limits=(-1.0, 1.0))
    m = trajectory_of(b, 3.0)
    fastest = math.sqrt(3 * G * math.sin(1.0))  # rad/s of a falling rod of 1 m at the limit
    assert np.abs(np.diff(m.angle[:, arm])).max() < 1.05 * fastest / 60
    assert m.angle[:, arm].min() > -1.0 - math.radians(1)
    assert m.angle[-1, arm] == pytest.approx(-1.0, abs=math.radians(0.5))


# Slots, positions, cost


def test_every_slot_behaves_alike():
    """The last pair is treated differently, and a body in polygon slots 0 to 3 falls through the floor."""
    ends = []
    for slot in range(CAPACITY.polygons - 1):
        b = builder()
        for k in range(slot):
            b.add_box(width=1, height=1, position=(100 + 3 * k, 0), fixed=True)
        box = b.add_box(width=0.5, height=0.5, position=(0, 1), angle=0.2)
        ball = b.add_circle(radius=0.2, position=(2, 1))
        floor(b)
        end = run(b.build(), 3.0)
        ends.append([*end.position[box], *end.position[ball]])
        assert end.position[box, 1] == pytest.approx(0.25, abs=0.02)
        assert end.position[ball, 1] == pytest.approx(0.2, abs=0.02)
    np.testing.assert_allclose(ends, [ends[0]] * len(ends), atol=1e-6)  # same order of pairs, same arithmetic


def test_bodies_go_on_beyond_fifteen_metres():
    """Positions are clipped there while the velocity is kept."""
    b = builder(gravity=(0, 0))
    ball = b.add_circle(radius=0.2, velocity=(10, 0))
    assert trajectory_of(b, 5.0).position[-1, ball, 0] == pytest.approx(50.0, abs=0.01)


def test_empty_scene_costs_a_tenth_of_a_full_one_at_most():
    """76 % of a full one; 1 % here. Size L, as full as it gets."""
    capacity = SIZES["l"]
    full, empty = SceneBuilder(capacity), SceneBuilder(capacity)
    full.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    for k in range(capacity.polygons - 1):
        full.add_box(width=0.5, height=0.5, position=(0.55 * (k % 4), 0.25 + 0.5 * (k // 4)))
    for k in range(capacity.circles):
        full.add_circle(radius=0.25, position=(-0.55 * (k + 1), 0.25))
    one = Engine(capacity)

    def seconds(b: SceneBuilder) -> float:
        world = b.build()
        scene, state = (
            one.pack_scene(stack_worlds([world.scene] * 256)),
            stack_worlds([one.initial_state(*world)] * 256),
        )
        step = jax.jit(lambda packed: one.step_packed(scene, packed, one.no_controls(256), num_steps=60)[0])
        packed = jax.block_until_ready(step(one.pack_state(state)))
        times = []
        for _ in range(5):
            start = time.process_time()  # of this process alone: other work does not count
            jax.block_until_ready(step(packed))
            times.append(time.process_time() - start)
        return min(times)

    assert seconds(empty) < 0.1 * seconds(full)
