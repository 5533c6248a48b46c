"""Worlds sorted by structure: counts by hand, a permutation with its inverse, the same bits as in any other order."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import (
    STRUCTURE,
    Capacity,
    Controls,
    Effects,
    Engine,
    MissingEffectError,
    SceneBuilder,
    WorldOrder,
    index_worlds,
    order_by_structure,
    stack_worlds,
    structure_of,
)
from jax2d.world_order import sorting

CAPACITY = Capacity(polygons=3, circles=3, joints=2, thrusters=1)
NUM_WORLDS, STEPS = 48, 60  # one second


def world(number: int):
    """A floor and, by the number, boxes and balls that fall on it, some of them joined."""
    b = SceneBuilder(CAPACITY)
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    height = 0.4 + 0.01 * number
    boxes = [b.add_box(width=0.5, height=0.3, position=(1.2 * i, height)) for i in range(number % 3)]
    balls = [b.add_circle(radius=0.15, position=(1.2 * i, height + 0.7)) for i in range(number % 4)]
    if boxes and balls:
        if number % 2:
            b.add_fixed_joint(boxes[0], balls[0], at=(0, height + 0.4))
        else:
            b.add_revolute_joint(boxes[0], balls[0], at=(0, height + 0.4), motor_speed=1, motor_power=1)
    if len(balls) > 2:
        b.add_prismatic_joint(balls[1], balls[2], at=(1.2, height + 0.7), axis_angle=0.0)
    return b.build()


@functools.cache
def engine() -> Engine:
    return Engine(CAPACITY)


@functools.cache
def worlds():
    built = [world(number) for number in np.random.default_rng(0).permutation(NUM_WORLDS)]
    return stack_worlds([one.scene for one in built]), stack_worlds([engine().initial_state(*one) for one in built])


def test_structure_counts_what_acts():
    b = SceneBuilder(CAPACITY)
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    box = b.add_box(width=0.5, height=0.3, position=(0, 1))
    ball = b.add_circle(radius=0.2, position=(0, 2))
    other = b.add_circle(radius=0.2, position=(2, 2))
    b.add_revolute_joint(box, ball, at=(0, 1.5))  # what is joined does not touch
    b.add_fixed_joint(ball, other, at=(1, 2))
    scene = b.build().scene
    expected = {
        "revolute_joints": 1,
        "fixed_joints": 1,
        "prismatic_joints": 0,
        "movable_bodies": 3,
        "circles": 2,
        "polygons": 2,
        "polygon_pairs": 1,  # floor and box
        "polygon_circle_pairs": 3,  # floor and both balls, box and the other ball
        "circle_pairs": 0,
    }
    assert dict(zip(STRUCTURE, structure_of(scene).tolist(), strict=True)) == expected
    # Slots that are not active count nowhere, whatever they hold.
    active = np.array(scene.shapes.active)
    active[ball] = False
    without = scene.replace(shapes={"active": active})
    assert structure_of(without).tolist() == [0, 0, 0, 2, 1, 2, 1, 2, 0]
    everything = np.ones_like(scene.shapes.can_touch) & ~np.eye(CAPACITY.shapes, dtype=bool)
    assert structure_of(without.replace(shapes={"can_touch": everything})).tolist() == [0, 0, 0, 2, 1, 2, 1, 2, 0]


def test_worlds_of_any_batch_are_counted_like_each_alone():
    scene, _ = worlds()
    each = [structure_of(index_worlds(scene, number)).tolist() for number in range(NUM_WORLDS)]
    assert structure_of(scene).tolist() == each
    in_two_axes = jax.tree.map(lambda x: x.reshape(4, 12, *x.shape[1:]), scene)
    assert jax.jit(structure_of)(in_two_axes).reshape(NUM_WORLDS, -1).tolist() == each


def test_the_order_rises_in_structure_and_is_stable():
    scene, _ = worlds()
    order = jax.jit(order_by_structure)(scene)
    keys = [(*counts, number) for number, counts in enumerate(structure_of(scene).tolist())]
    assert order.worlds.tolist() == [number for *_, number in sorted(keys)]
    assert len({key[:-1] for key in keys}) > 5, "worlds of one structure test nothing"


def test_restoring_undoes_sorting_along_any_axis():
    order = order_by_structure(worlds()[0])
    assert sorted(order.worlds.tolist()) == list(range(NUM_WORLDS))
    np.testing.assert_array_equal(order.worlds[order.places], np.arange(NUM_WORLDS))
    tree = {"first": jnp.arange(NUM_WORLDS), "last": jnp.arange(3 * NUM_WORLDS).reshape(3, NUM_WORLDS)}
    first, last = order.sort(tree["first"]), order.sort(tree["last"], axis=-1)
    assert first.tolist() == order.worlds.tolist() != tree["first"].tolist()
    np.testing.assert_array_equal(order.restore(first), tree["first"])
    np.testing.assert_array_equal(order.restore(last, axis=-1), tree["last"])


def test_no_world_at_all_and_one_structure_for_all():
    assert sorting(np.zeros((0, 3), np.int32)).worlds.shape == (0,)
    assert sorting(np.ones((5, 3), np.int32)).worlds.tolist() == list(range(5))


def test_a_single_scene_is_refused():
    with pytest.raises(ValueError, match=r"structure has shape \(9,\); worlds of one batch have \[worlds, counts\]"):
        order_by_structure(index_worlds(worlds()[0], 0))


def controls_of_steps() -> Controls:
    keys = jax.random.split(jax.random.key(0))
    return Controls(
        motor=jax.random.uniform(keys[0], (STEPS, NUM_WORLDS, CAPACITY.joints), minval=-1),
        thruster=jax.random.uniform(keys[1], (STEPS, NUM_WORLDS, CAPACITY.thrusters)),
    )


@pytest.mark.also_gpu
def test_every_world_moves_bit_for_bit_alike_in_both_orders():
    one, (scene, state) = engine(), worlds()

    @jax.jit
    def play(packed_scene, packed, controls):
        def step(packed, now):
            return one.step_packed(packed_scene, packed, now)

        packed, reports = jax.lax.scan(step, packed, controls)
        return one.unpack_state(packed), reports

    drawn = play(one.pack_scene(scene), one.pack_state(state), controls_of_steps())
    packed_scene, packed, order = one.pack_sorted(scene, state)
    assert order.worlds.tolist() != list(range(NUM_WORLDS))
    end, reports = play(packed_scene, packed, order.sort(controls_of_steps(), axis=1))
    restored = order.restore(end), order.restore(reports, axis=1)
    jax.tree.map(np.testing.assert_array_equal, restored, drawn)
    assert np.asarray(drawn[1].during).any(), "nothing touched"


def test_packing_in_order_names_worlds_by_their_number_in_the_scene():
    scene, state = worlds()
    without = Engine(CAPACITY, effects=Effects.full(CAPACITY).without("prismatic_joints"))
    sliders = np.flatnonzero(structure_of(scene)[:, STRUCTURE.index("prismatic_joints")])
    with pytest.raises(MissingEffectError, match=f"^scene {sliders[0]} calls for prismatic_joints"):
        without.pack_sorted(scene, state)
    with pytest.raises(ValueError, match=r"^scene has 48 worlds, state 47"):
        engine().pack_sorted(scene, index_worlds(state, slice(47)))


def test_an_order_passes_through_jit():
    order = jax.jit(lambda order: order)(sorting(np.array([[2], [1]], np.int32)))
    assert isinstance(order, WorldOrder) and order.worlds.tolist() == order.places.tolist() == [1, 0]
