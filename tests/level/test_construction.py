"""Building action by action: every sequence of allowed choices gives a valid level."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import JointKind
from jax2d.scene import Capacity
from kinetix_dist.env.action_spaces.masked_categorical import MaskedCategorical, forbid
from kinetix_dist.level.construction import (
    HEADS,
    NUM_DRAWS,
    Addition,
    allowed,
    apply_action,
    begin,
    check_construction,
    finish,
    head_sizes,
    num_order_draws,
    num_steps,
)
from kinetix_dist.level.document import level_to_json
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_WALLS, SIZES, Role
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.schema import level_from_json
from tests.level.valid import assert_valid

CONFIG = GeneratorConfig()
NUM_LEVELS = 192
# Logits that a teacher may come to have: none, one choice again and again, the last or the first allowed choice.
TASTES = {
    "any": lambda head, choices: 0.0 * jnp.arange(choices),
    "joints": lambda head, choices: (
        9.0 * ((head == "addition") & (jnp.arange(choices) // 2 * 2 + 1 == Addition.JOINED_BOX))
    ),
    "fixed": lambda head, choices: 9.0 * ((head == "is_fixed") & (jnp.arange(choices) == 1)),
    "last": lambda head, choices: 9.0 * jnp.arange(choices),
    "first": lambda head, choices: -9.0 * jnp.arange(choices),
    "nothing": lambda head, choices: 30.0 * ((head == "addition") & (jnp.arange(choices) == Addition.NOTHING)),
}


@functools.cache
def builder(size):
    """(key, logits of each head) -> (levels, constructions before slots were shuffled, was every action allowed)"""
    capacity = SIZES[size]
    distribution = MaskedCategorical(head_sizes=head_sizes(capacity))

    def run(key, logits):
        keys = jax.random.split(key, NUM_LEVELS)

        def step(building, number):
            masks = jax.vmap(lambda one: allowed(one, number, capacity, CONFIG))(building)
            draw = jax.vmap(lambda k: jax.random.uniform(jax.random.fold_in(k, number), (len(HEADS) + NUM_DRAWS,)))
            draws = draw(keys)
            actions, log_prob = distribution.sample(forbid(logits, masks), draws[:, : len(HEADS)])
            is_allowed = [jnp.take_along_axis(m, actions[:, i, None], 1).all() for i, m in enumerate(masks)]
            act = jax.vmap(lambda one, a, d: apply_action(one, number, a, d, capacity, CONFIG))
            building = act(building, actions, draws[:, len(HEADS) :])
            return building, jnp.stack([*is_allowed, jnp.isfinite(log_prob).all()]).all()

        empty = jax.tree.map(lambda x: jnp.broadcast_to(x, (NUM_LEVELS, *x.shape)), begin(capacity))
        building, is_allowed = jax.lax.scan(step, empty, jnp.arange(num_steps(capacity)))
        order = jax.random.uniform(key, (NUM_LEVELS, num_order_draws(capacity)))
        return jax.vmap(lambda one, draws: finish(one, draws, capacity))(building, order), building, is_allowed.all()

    return jax.jit(run)


@functools.cache
def built(size, taste):
    logits = tuple(TASTES[taste](head, n) for head, n in zip(HEADS, head_sizes(SIZES[size]), strict=True))
    return jax.tree.map(np.asarray, builder(size)(jax.random.key(7), logits))


@pytest.fixture(
    params=[
        *((size, taste) for size in "sm" for taste in TASTES),
        pytest.param(("l", "any"), marks=pytest.mark.slow),
        pytest.param(("l", "joints"), marks=pytest.mark.slow),
    ],
    ids="-".join,
    scope="module",
)
def case(request):
    return request.param


def test_every_level_is_valid_and_every_choice_was_allowed(case):
    size, _ = case
    level, _, is_allowed = built(*case)
    assert is_allowed
    assert_valid(level, SIZES[size])
    fixed = level.scene.shapes.inverse_mass == 0
    is_set = (level.shape_role == Role.GREEN) | (level.shape_role == Role.BLUE)
    assert (is_set & ~fixed & level.scene.shapes.active).any(1).all()  # one of the two can move
    if size == "s":
        assert (fixed.sum(1) - (~level.scene.shapes.active).sum(1) == NUM_WALLS).all()  # as in the generator's S


def test_every_level_has_something_to_control(case):
    level, _, _ = built(*case)
    joints = level.scene.joints
    is_motor = joints.active & joints.motor_on & ~joints.is_kind(JointKind.FIXED)
    assert (is_motor.any(1) | level.scene.thrusters.active.any(1)).all()


def test_no_two_bodies_overlap_at_the_start(case):
    """Separating axes of all pairs, walls included."""
    _, building, _ = built(*case)
    shapes = building.draft.shapes
    corners = world_corners(shapes.position, shapes.angle, shapes.vertices)
    pairs = jax.vmap(jax.vmap(separation, (None, None, 0, 0)), (0, 0, None, None))
    gap = np.asarray(jax.jit(jax.vmap(pairs))(corners, shapes.radius, corners, shapes.radius))
    both = shapes.active[:, :, None] & shapes.active[:, None, :]
    apart = both & (shapes.body[:, :, None] != shapes.body[:, None, :])
    is_wall = np.arange(shapes.active.shape[1]) < NUM_WALLS
    apart &= ~(is_wall[:, None] & is_wall[None, :])
    assert gap[apart].min() > -1e-5  # m, float32 sums of another order
    assert (both & ~apart).any()


def test_levels_survive_their_file(case):
    """Files are checked by a schema and by rules of their own."""
    size, _ = case
    level, _, _ = built(*case)
    for i in range(0, NUM_LEVELS, 48):
        one = jax.tree.map(lambda x, i=i: x[i], level)
        again = level_from_json(level_to_json(one), size)
        assert np.sum(again.scene.shapes.active) == np.sum(one.scene.shapes.active)
        assert np.sum(again.scene.joints.active) == np.sum(one.scene.joints.active)


def test_joined_levels_have_joints_of_all_kinds():
    joints = built("m", "any")[0].scene.joints
    kinds = joints.kind[joints.active]
    assert {JointKind.FIXED, JointKind.REVOLUTE} == {JointKind(int(kind)) for kind in kinds}
    assert joints.has_limits[joints.active].any() and not joints.has_limits[joints.active].all()
    assert (joints.a[joints.active] < joints.b[joints.active]).all()


@pytest.mark.parametrize(
    ("capacity", "config", "said"),
    [
        (Capacity(polygons=5, circles=2, joints=0, thrusters=1), CONFIG, "needs room for 2 shapes"),
        (
            SIZES["s"],
            dataclasses.replace(CONFIG, max_shape_size=2.4, large_rectangle_scale=1.0),
            r"^shapes of the generator reach 1.2 m .* lower max_shape_size or large_rectangle_scale$",
        ),
    ],
)
def test_what_cannot_be_built_is_refused(capacity, config, said):
    with pytest.raises(ValueError, match=said):
        check_construction(capacity, config)
