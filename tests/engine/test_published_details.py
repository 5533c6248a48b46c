"""Preset `paper` follows its appendix; each detail of bench/published_solver.py does what the published package does.

Hand-worked cases first; then single steps recorded from the package (jax2d 1.0.2); where it is installed, new ones.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench import published_order, published_solver
from bench.paper_single_steps import PUBLISHED, agreement, step
from bench.peer_process import PUBLISHED_JAX2D_STEPS, PeerMissing
from bench.published_order import Published
from bench.published_solver import DETAILS
from bench.published_steps import Steps, load, run_published
from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset
from jax2d.constants import CONSTANTS
from jax2d.scene import Controls, only_what_acts
from jax2d.solver_numbers import solver_numbers
from jax2d.xla import contacts, geometry, joints, paper
from jax2d.xla.bodies import Bodies, Velocities
from jax2d.xla.contact_solver import rows_of
from jax2d.xla.contacts import ContactCache, Contacts, Context
from jax2d.xla.pairs import pair_list
from jax2d.xla.rules import rules_of
from tests.helpers import REPOSITORY

FOUR = Capacity(polygons=2, circles=2, joints=0, thrusters=0)
CIRCLE = FOUR.polygons
RECORDED = Path(__file__).parent / "published_steps_m.npz"
DT = 1 / 60


def published(*details: str, batch_size: int = 1) -> Published:
    return Published(frozenset(details), batch_size)


def at_rest(position: jax.Array | np.ndarray, angle: jax.Array | np.ndarray) -> Bodies:
    zeros = jnp.zeros_like(angle)
    ones = jnp.ones_like(angle)
    still = jnp.zeros_like(position)
    return Bodies(
        position=jnp.asarray(position),
        angle=jnp.asarray(angle),
        velocities=Velocities(still, zeros),
        delta=still,
        turn=zeros,
        inverse_mass=ones,
        inverse_inertia=ones,
        is_kinematic=zeros > 0,
        limited=zeros[0],
        slowed=zeros > 0,
        wraps=ones == 0,
    )


@functools.partial(jax.jit, static_argnums=1)
def _find(world: BuiltWorld, details: Published) -> Contacts:
    b = at_rest(jnp.asarray(world.position), jnp.asarray(world.angle))
    slots = FOUR.contact_slots
    memory = ContactCache(jnp.full(slots, -1), jnp.zeros((slots, 2)))
    params = solver_numbers(preset("paper"))
    scene = only_what_acts(world.scene)
    context = Context(scene, params, rules_of(preset("paper")), FOUR)
    if not details.details:
        return contacts.find(b, geometry.build(scene, b), memory, context, DT)
    return published_solver.find(b, geometry.build(scene, b), memory, context, details)[0]


def found(b: SceneBuilder, *details: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(normal [c, 2], point [c, 2] in world coordinates, separation [c], feature [c]) of the contacts of a world."""
    world = b.build()
    c = jax.tree.map(np.asarray, _find(world, published(*details)))
    used = c.key >= 0
    first = np.argmax(c.pair.is_a[used], axis=1)
    feature_bits = (1 << CONSTANTS.feature_bits) - 1
    return c.normal[used], world.position[first] + c.arm_a[used], c.separation[used], c.key[used] & feature_bits


def close(x: Any, y: Any) -> None:
    np.testing.assert_allclose(x, y, atol=2e-6)  # float32, coordinates of a few metres


# What the appendix prescribes


def test_point_of_two_circles_is_on_the_first() -> None:
    """p = p_a + r_a n."""
    b = SceneBuilder(FOUR)
    b.add_circle(radius=0.5)
    b.add_circle(radius=0.3, position=(0.7, 0))
    normal, point, separation, _ = found(b)
    close(normal, [(1, 0)])
    close(point, [(0.5, 0)])
    close(separation, [-0.1])


@pytest.mark.parametrize(
    ("centre", "normal", "point"), [((1.4, 0.2), (1, 0), (1, 0.2)), ((1.24, 1.32), (0.6, 0.8), (1, 1))]
)
def test_point_of_polygon_and_circle_is_the_closest_of_the_polygon(centre, normal, point) -> None:
    b = SceneBuilder(FOUR)
    b.add_box(width=2, height=2)
    b.add_circle(radius=0.5, position=centre)
    seen = found(b)
    close(seen[0], [normal])
    close(seen[1], [point])
    close(seen[2], [-0.1])


def on_a_floor(*corners: tuple[float, float]) -> SceneBuilder:
    b = SceneBuilder(FOUR)
    b.add_box(width=10, height=10, position=(0, -5), fixed=True)
    b.add_polygon(corners)
    return b


# Its two lowest corners are those of a short edge that faces up a little; the edge that faces the floor is a long one.
WEDGE = ((-2.0, -0.05), (0.0, -0.3), (-0.05, -0.18))


def test_points_of_polygons_are_those_of_the_incident_face_with_the_deepest_corners() -> None:
    normal, point, separation, _ = found(on_a_floor(*WEDGE))
    close(normal, [(0, 1), (0, 1)])
    close(sorted(point.tolist()), [(-0.05, -0.18), (0, -0.3)])
    close(sorted(separation), [-0.3, -0.18])


def test_only_points_that_penetrate_are_points() -> None:
    normal, point, _, _ = found(on_a_floor((0, -0.1), (1, 0.01), (0.5, 1)))
    close(point, [(0, -0.1)])
    close(normal, [(0, 1)])


def test_motors_act_all_at_once() -> None:
    """The middle one of three discs on a chain with equal motors gets as much from either side, whichever is first."""
    capacity = Capacity(polygons=0, circles=3, joints=2, thrusters=0)
    b = SceneBuilder(capacity)
    for i in range(3):
        b.add_circle(radius=0.5, position=(i, 0))
    for i in range(2):
        b.add_revolute_joint(i, i + 1, at=(i + 0.5, 0), motor_speed=1, motor_power=2)
    world = b.build()
    loaded = at_rest(world.position, world.angle)
    loaded = loaded._replace(inverse_inertia=jnp.full(3, 10.0))
    params = solver_numbers(preset("paper"))
    none = joints.WarmStart(joints.JointImpulses(jnp.zeros((2, 2)), *jnp.zeros((3, 2))), jnp.zeros(0))
    controls = Controls(motor=jnp.ones(2), thruster=jnp.zeros(0))
    held = joints.prepare(loaded, jax.tree.map(jnp.asarray, world.scene), none, controls, params)
    omega = paper.apply_motors(loaded, held, params).velocities.omega
    # j = p tanh(s rho), p = 2 * 900 / 60 * (1 / (1/I + 1/I)); each body turns by j / I.
    turned = 2 * 900 / 60 * math.tanh(6 * 0.1) / 2
    close(omega, [-turned, 0, turned])


# Details of manifolds


def test_reference_bias() -> None:
    """The upper one's face overlaps 3 mm less, so it is the reference; with a bias of 1 cm it is not."""
    corners = ((-0.3, -0.002), (0.9, -0.01), (0.9, 1), (-0.3, 1))
    b = SceneBuilder(FOUR)
    b.add_box(width=1, height=1, position=(0, -0.5))
    b.add_polygon(corners)
    length = math.hypot(0.008, 1.2)
    close(found(b)[0], [(0.008 / length, 1.2 / length)] * 2)
    close(found(b, "reference_bias")[0], [(0, 1)] * 2)


def test_clip_keeps_depth() -> None:
    """The corner 1 cm deep is clipped to x = 0.5, where the face is 7.33 mm deep."""
    corners = ((-0.3, -0.002), (0.9, -0.01), (0.9, 1), (-0.3, 1))
    b = SceneBuilder(FOUR)
    b.add_box(width=1, height=1, position=(0, -0.5))
    b.add_polygon(corners)
    clipped, deep = found(b, "reference_bias"), found(b, "reference_bias", "clip_keeps_depth")
    for seen, depth in ((clipped, 0.002 + 0.008 * 0.8 / 1.2), (deep, 0.01)):
        close(sorted(seen[2]), [-depth, -0.002])
        close(sorted(seen[1].tolist()), [(-0.3, -0.002), (0.5, -depth)])


def test_deepest_depth() -> None:
    close(found(on_a_floor(*WEDGE), "deepest_depth")[2], [-0.3, -0.3])


def test_centre_inside() -> None:
    b = SceneBuilder(FOUR)
    b.add_box(width=2, height=2)
    b.add_circle(radius=0.5, position=(0.7, 0.1))
    close(found(b)[2], [-0.8])
    close(found(b, "centre_inside")[2], [-0.5])
    b = SceneBuilder(FOUR)
    b.add_box(width=2, height=2)
    b.add_circle(radius=0.5, position=(1, 0.1))
    close(found(b)[0], [(1, 0)])
    close(found(b, "centre_inside")[0], [(0, 0)])


def test_coincident_circles() -> None:
    b = SceneBuilder(FOUR)
    b.add_circle(radius=0.5)
    b.add_circle(radius=0.3)
    close(found(b)[0], [(0, 1)])
    close(found(b, "coincident_circles")[0], [(0, 0)])


def test_fixed_slots() -> None:
    b = on_a_floor(*WEDGE)
    b.add_circle(radius=0.5, position=(3, 0.4))
    assert len(found(b)[2]) == 3
    assert len(found(b, "fixed_slots")[2]) == 1  # of the circle
    six = Capacity(polygons=6, circles=1, joints=0, thrusters=0)
    pairs = pair_list(six)
    fixed = published_order.is_fixed_pair(pairs, six)
    assert {(a, b) for a, b in zip(pairs.point_a[fixed], pairs.point_b[fixed])} == {
        (a, b) for b in range(4) for a in range(b)
    }


def test_warm_start_by_depth() -> None:
    """The deeper point of a pair is the first, whichever corner it is."""
    wedge = on_a_floor(*WEDGE)
    mirrored = on_a_floor(*((-x, y) for x, y in reversed(WEDGE)))
    for b in (wedge, mirrored):
        _, _, separation, feature = found(b, "warm_start_by_depth")
        close(separation, [-0.3, -0.18])
        assert feature.tolist() == [0, 1]


# Details of solving

MANY = Capacity(polygons=5, circles=3, joints=1, thrusters=0)


def turns(in_contact: list[tuple[int, int]], *details: str, batch_size: int, joined: bool) -> dict[tuple, list[int]]:
    """The batches of the points of these pairs, in a world where 0 and 3 are held together or just kept apart."""
    b = SceneBuilder(MANY)
    for i in range(MANY.polygons):
        b.add_box(width=1, height=1, position=(2 * i, 0))
    for i in range(MANY.circles):
        b.add_circle(radius=0.5, position=(2 * i, 2))
    if joined:
        b.add_revolute_joint(0, 3, at=(0, 0))
    else:
        b.keep_apart(0, 3)
    scene = jax.tree.map(jnp.asarray, only_what_acts(b.build().scene))
    pairs = pair_list(MANY)
    names = [(int(i), int(j)) for i, j in zip(pairs.point_a, pairs.point_b)]
    overlaps = jnp.array([name in in_contact for name in names])
    dynamic = jnp.ones(MANY.shapes, bool)
    r = published("solve_order", *details, batch_size=batch_size)
    found = published_order.solve_order(overlaps, scene, dynamic, pairs, MANY, r)
    return {pair: [int(found.batch[k]) for k, name in enumerate(names) if name == pair] for pair in in_contact}


def test_solve_order() -> None:
    """Pairs in contact have the last ranks of their kind; neighbours fall into different batches.

    Batches of 4: 10 pairs of polygons in 3 batches, deepest points first (0 to 2), other points next (3 to 5); 15 of
    polygon and circle in 4 batches (6 to 9), circle by circle; 3 of circles in batch 10.
    """
    first_circle = MANY.polygons
    contacts_of_circles = [(2, first_circle), (0, first_circle + 1), (first_circle + 1, first_circle + 2)]
    seen = turns([(0, 1), (0, 2), *contacts_of_circles], batch_size=4, joined=False)
    assert seen[(0, 1)] == [8 % 3, 3 + 8 % 3]
    assert seen[(0, 2)] == [9 % 3, 3 + 9 % 3]
    assert seen[contacts_of_circles[0]] == [6 + 13 % 4]
    assert seen[contacts_of_circles[1]] == [6 + 14 % 4]
    assert seen[contacts_of_circles[2]] == [10]


def test_solve_order_counts_overlapping_shapes_of_one_body() -> None:
    """0 and 3 overlap. Held together they have the last rank, although they are not solved; kept apart they do not."""
    overlapping = [(0, 1), (0, 2), (0, 3)]
    assert turns(overlapping, batch_size=4, joined=True)[(0, 1)][0] == 7 % 3
    assert turns(overlapping, batch_size=4, joined=False)[(0, 1)][0] == 8 % 3


def test_solve_order_without_pairs_of_fixed_slots() -> None:
    """4 pairs of polygons are left, in 1 batch for their deepest points and 1 for the others."""
    assert published_order.num_batches(MANY, published("solve_order", "fixed_slots", batch_size=4)) == 1 + 1 + 4 + 1
    assert turns([(0, 4)], "fixed_slots", batch_size=4, joined=False)[(0, 4)] == [0, 1]


def test_batches_of_a_turn_are_solved_one_after_another() -> None:
    """A ball at rest is hit from both sides at 1 m/s. The batch says who is first and whether either sees the other."""
    balls = Capacity(polygons=0, circles=3, joints=0, thrusters=0)
    b = SceneBuilder(balls, gravity=(0, 0))
    b.add_circle(radius=0.5)
    b.add_circle(radius=0.5, position=(-0.999, 0), velocity=(1, 0))
    b.add_circle(radius=0.5, position=(0.999, 0), velocity=(-1, 0))
    world = b.build()
    expected = {
        1: [-0.25, 0.5, -0.25],  # one after the other: 0.5 against -1 closes at 1.5, shared
        3: [0, 0.5, -0.5],  # both at once
        2: [0.25, 0.25, -0.5],  # ranks 1 and 2 of 3 fall into batches 1 and 0: the right one first
    }
    for batch_size, velocity in expected.items():
        one = Engine(balls, settings=preset("paper").replace(substeps=1), backend="xla")
        start = (world.scene, one.initial_state(*world), one.no_controls())
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], start)
        details = published("solve_order", batch_size=batch_size)
        close(published_solver.step(balls, one.settings, details, *batch)[0].velocity[0, :, 0], velocity)


@pytest.mark.parametrize(
    ("batch_size", "kinds"), [(4, {"polygons", "polygon and circle", "circles"}), (5, {"circles"})]
)
def test_last_pair_of_a_kind_is_dropped_unless_batches_are_full(batch_size: int, kinds: set[str]) -> None:
    """10, 15 and 3 pairs: full in batches of 5, but for the circles'."""
    pairs = pair_list(MANY)
    nothing = jnp.zeros(len(pairs.point_a), bool)
    scene = jax.tree.map(jnp.asarray, only_what_acts(SceneBuilder(MANY).build().scene))
    r = published("last_pair", batch_size=batch_size)
    seen = published_order.solve_order(nothing, scene, jnp.zeros(MANY.shapes, bool), pairs, MANY, r)
    dropped = np.asarray(seen.is_dropped)
    last = {"polygons": [(3, 4), (3, 4)], "polygon and circle": [(4, 7)], "circles": [(6, 7)]}
    assert sorted(zip(pairs.point_a[dropped], pairs.point_b[dropped])) == sorted(
        pair for kind in kinds for pair in last[kind]
    )


def test_arms_follow_joints() -> None:
    """A disc that a joint's correction moved by 0.1 m towards the point has an arm of 0.4 m left."""
    b = SceneBuilder(FOUR)
    b.add_circle(radius=0.5)
    b.add_circle(radius=0.5, position=(0.9, 0.1))
    world = b.build()
    rows = rows_of(_find(world, published()))
    moved = at_rest(world.position, world.angle)._replace(delta=jnp.zeros((4, 2)).at[CIRCLE].set((0.1, 0.0)))
    followed = published_solver.arms_from_here(moved, rows)
    close(followed.arm_a[0], rows.arm_a[0] - np.array([0.1, 0]))
    close(followed.arm_b[0], rows.arm_b[0])
    tangent = np.array([rows.normal[0, 1], -rows.normal[0, 0]])
    arm, other = (x[0] * tangent[1] - x[1] * tangent[0] for x in (followed.arm_a[0], followed.arm_b[0]))
    pair = rows.pair
    effective = pair.mass_a[0] + pair.mass_b[0] + pair.inertia_a[0] * arm**2 + pair.inertia_b[0] * other**2
    close(followed.mass_tangent[0], 1 / effective)


def test_state_clips() -> None:
    """Positions stop at 15 m while velocity is kept; a component of 120 m/s has moved the body before it is clipped."""
    before = at_rest(np.array([[14.9, 0.0], [0.0, 0.0]]), np.zeros(2))
    before = before._replace(velocities=Velocities(jnp.array([[20.0, 0.0], [120.0, 50.0]]), jnp.array([0.0, -60.0])))
    ended = published_solver.move_and_clip(before, DT, 100.0, 50.0)
    close(ended.position + ended.delta, [(15, 0), (2, 50 * DT)])
    close(ended.velocities.velocity, [(20, 0), (100, 50)])
    close(ended.velocities.omega, [0, -50])
    close(ended.turn, [0, -1])
    assert int(ended.limited) == 2


# The package itself


def assert_agrees(steps: Steps, dtype: str) -> None:
    with jax.enable_x64(True):
        for start in ("warm", "cold"):
            if (dtype, start) in steps.after:
                agrees, apart = agreement(step(steps, PUBLISHED, dtype, start), steps, dtype, start)
                assert agrees.all(), (start, np.flatnonzero(~agrees), {k: v.max() for k, v in apart.items()})


def test_steps_recorded_from_the_package_agree_to_rounding() -> None:
    """Compares two states of each public level of size M: one as played and one stirred each, with warm-start impulses,
    float64."""
    steps = load(RECORDED)
    assert len(steps.contact_key) == 48
    assert np.sum(steps.contact_key >= 0) > 48
    assert_agrees(steps, "float64")


@pytest.mark.slow
def test_the_package_takes_the_same_steps(public_levels: Path, tmp_path: Path) -> None:
    try:
        PUBLISHED_JAX2D_STEPS.python()
    except PeerMissing as error:
        pytest.skip(str(error))
    run_published(sorted((public_levels / "s").glob("*.json")), (4, 60, 200), 1, tmp_path / "steps.npz")
    steps = load(tmp_path / "steps.npz")
    for dtype in ("float64", "float32"):
        assert_agrees(steps, dtype)


def test_unknown_details_are_refused() -> None:
    with pytest.raises(ValueError, match="'mass_defects' is no detail; known: reference_bias, "):
        published_solver.step(FOUR, preset("paper"), published("mass_defects"), *[None] * 3)  # type: ignore[arg-type]


def test_every_detail_is_documented() -> None:
    text = (REPOSITORY / "docs" / "engine_solver.md").read_text()
    assert [name for name in DETAILS if f"`{name}`" not in text] == []
