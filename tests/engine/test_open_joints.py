"""Joints, ropes and rods that do not hold are reported and counted, and mechanisms with contradictions stay finite."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, measure, preset, stack_worlds

CAPACITY = Capacity(polygons=5, circles=0, joints=5, thrusters=0)
HANGING = Capacity(polygons=2, circles=2, joints=1, thrusters=0, springs=2)
PRESETS = ("draft", "standard", "fine")
BACKENDS = ("warp", "xla")


def bar_between_posts(apart: float) -> BuiltWorld:
    """A bar of 1 m that is pinned at both ends to fixed posts, which are by so much farther apart than its holes."""
    builder = SceneBuilder(CAPACITY)
    left, right = (builder.add_box(width=0.2, height=0.2, position=(x, 0), fixed=True) for x in (0.0, 1.0))
    bar = builder.add_box(width=1, height=0.1, position=(0.5, 0))
    builder.add_revolute_joint(left, bar, at=(0, 0))
    builder.add_revolute_joint(right, bar, at=(1, 0))
    return moved(builder.build(), right, (apart, 0))


def loop_that_cannot_close() -> BuiltWorld:
    """Three bars of 1 m in a row from post to post, 10 m apart: farther than they reach."""
    builder = SceneBuilder(CAPACITY)
    left, right = (builder.add_box(width=0.2, height=0.2, position=(x, 0), fixed=True) for x in (0.0, 3.0))
    bars = [builder.add_box(width=1, height=0.1, position=(k + 0.5, 0)) for k in range(3)]
    for k, (a, b) in enumerate(zip([left, *bars], [*bars, right])):
        builder.add_revolute_joint(a, b, at=(k, 0))
    return moved(builder.build(), right, (7, 0))


def welds_that_disagree() -> BuiltWorld:
    """A bar that is welded to two posts, one of which has turned by half a radian since."""
    builder = SceneBuilder(CAPACITY)
    left, right = (builder.add_box(width=0.2, height=0.2, position=(x, 0), fixed=True) for x in (0.0, 1.0))
    bar = builder.add_box(width=1, height=0.1, position=(0.5, 0))
    builder.add_fixed_joint(left, bar, at=(0, 0))
    builder.add_fixed_joint(right, bar, at=(1, 0))
    world = builder.build()
    angle = np.array(world.angle)
    angle[right] += 0.5
    return world._replace(angle=angle)


def box_between_rails() -> BuiltWorld:
    """A box on two upright rails that are 0.5 m farther apart than its ends."""
    builder = SceneBuilder(CAPACITY)
    left, right = (builder.add_box(width=0.2, height=0.2, position=(x, 0), fixed=True) for x in (0.0, 1.0))
    box = builder.add_box(width=1, height=0.1, position=(0.5, 0))
    for x, post in ((0.0, left), (1.0, right)):
        builder.add_prismatic_joint(post, box, at=(x, 0), axis_angle=math.pi / 2, limits=(-0.5, 0.5))
    return moved(builder.build(), right, (0.5, 0))


def moved(world: BuiltWorld, shape: int, by: tuple[float, float]) -> BuiltWorld:
    position = np.array(world.position)
    position[shape] += by
    return world._replace(position=position)


CONTRADICTIONS = [
    bar_between_posts(0.5),
    bar_between_posts(20.0),
    loop_that_cannot_close(),
    welds_that_disagree(),
    box_between_rails(),
]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", PRESETS)
def test_what_contradicts_itself_stays_finite_comes_to_rest_and_is_counted(name: str, backend: str) -> None:
    engine = Engine(CAPACITY, settings=preset(name), backend=backend)
    scene = stack_worlds([world.scene for world in CONTRADICTIONS])
    start = stack_worlds([engine.initial_state(*world) for world in CONTRADICTIONS])
    state, touching = jax.jit(lambda state: engine.step(scene, state, num_steps=600))(start)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state))
    energy = jax.vmap(measure.kinetic_energy)(scene, state)
    assert float(energy.max()) < 1e-3  # J, of up to 0.3 kg; stretched joints hold still
    gaps, turns = (np.asarray(jax.vmap(f)(scene, state)) for f in (measure.joint_gaps, measure.joint_turns))
    is_open = (gaps > 0.01) | (turns > 0.05)
    assert np.asarray(touching.open_joints).tolist() == is_open.sum(-1).tolist()
    assert is_open.any(-1).all()
    # What is missing is missing: a gap cannot be smaller than the mechanism is too short.
    assert gaps[0].sum() == pytest.approx(0.5, abs=0.01)
    assert gaps[1].sum() == pytest.approx(20.0, abs=0.01)
    assert gaps[2].sum() == pytest.approx(7.0, abs=0.05)


@pytest.mark.parametrize("backend", BACKENDS)
def test_joints_that_hold_are_not_counted_and_one_that_starts_apart_is_until_it_has_closed(backend: str) -> None:
    engine = Engine(CAPACITY, backend=backend)
    builder = SceneBuilder(CAPACITY)
    post = builder.add_box(width=0.2, height=0.2, fixed=True)
    arm = builder.add_box(width=1, height=0.1, position=(0.5, 0))
    builder.add_revolute_joint(post, arm, at=(0, 0))
    holds = builder.build()
    apart = moved(holds, arm, (0.3, 0))  # closes at 3 m/s
    scene = stack_worlds([holds.scene, apart.scene])
    state = stack_worlds([engine.initial_state(*world) for world in (holds, apart)])
    counted = []
    for _ in range(30):
        state, touching = engine.step(scene, state)
        counted.append(touching.open_joints.tolist())
    holding, closing = zip(*counted)
    assert not any(holding)
    assert closing[0] == 1 and closing[-1] == 0


def load_on(kind: str, load_kg: float) -> BuiltWorld:
    """A load that hangs by two ropes, rods or limited springs of 1 m, with a disc of 0.03 kg between them."""
    builder = SceneBuilder(HANGING)
    before, at = builder.add_box(width=0.1, height=0.1, fixed=True, mask=0), (0.0, 0.0)
    for k, mass in enumerate((0.03, load_kg), start=1):
        place, density = (0.0, -float(k)), mass / (math.pi * 0.1**2)
        disc = builder.add_circle(radius=0.1, position=place, density=density, mask=0)
        if kind == "spring":
            builder.add_spring(before, disc, at_a=at, at_b=place, stiffness=100.0, max_length=1.0)
        else:
            getattr(builder, f"add_{kind}")(before, disc, at_a=at, at_b=place)
        before, at = disc, place
    return builder.build()


@pytest.mark.parametrize("backend", ["warp", pytest.param("xla", marks=pytest.mark.long)])
def test_ropes_rods_and_limits_of_springs_that_are_overloaded_are_counted(backend: str) -> None:
    engine = Engine(HANGING, backend=backend)
    kinds = ("rope", "rod", "spring")
    worlds = [load_on(kind, load_kg) for load_kg in (314.0, 1.0) for kind in kinds]
    scene = stack_worlds([world.scene for world in worlds])
    state = stack_worlds([engine.initial_state(*world) for world in worlds])
    step = jax.jit(lambda state: engine.step(scene, state, num_steps=10))
    counted = []
    for _ in range(12):
        state, touching = step(state)
        lengths = np.linalg.norm(np.diff(np.asarray(state.position)[:, [0, 2, 3]], axis=1), axis=-1)  # [6, 2] m
        errors = lengths - 1
        errors[1::3] = np.abs(errors[1::3])  # a rod is not to be shorter either
        np.testing.assert_array_equal(touching.open_joints, (errors > 0.01).sum(1))
        np.testing.assert_allclose(jax.vmap(measure.length_errors)(scene, state), np.maximum(errors, 0), atol=1e-5)
        assert not np.asarray(touching.limited).any() and not np.asarray(touching.overflow).any()
        counted.append(np.asarray(touching.open_joints))
    assert (np.array(counted)[:, :3].max(0) > 0).all()
    assert not np.array(counted)[:, 3:].any()


def test_joints_and_rods_between_two_fixed_bodies_are_not_counted() -> None:
    """The builder refuses them, but a body can be fixed later."""
    builder = SceneBuilder(HANGING)
    left, right = (builder.add_box(width=0.2, height=0.2, position=(x, 0), fixed=x == 0) for x in (0.0, 1.0))
    builder.add_rod(left, right, at_a=(0, 0), at_b=(1, 0))
    builder.add_revolute_joint(left, right, at=(0.5, 0))
    world = moved(builder.build(), right, (0.5, 0))
    assert measure.num_open(world.scene, world.position, world.angle) == 2
    for of_body in (world.scene.shapes.inverse_mass, world.scene.shapes.inverse_inertia):
        np.asarray(of_body)[right] = 0
    engine = Engine(HANGING)
    assert engine.step(world.scene, engine.initial_state(*world))[1].open_joints == 0
    assert measure.num_open(world.scene, world.position, world.angle) == 0


def test_turns_are_those_of_welds_and_sliders_and_full_turns_are_none() -> None:
    builder = SceneBuilder(CAPACITY)
    post = builder.add_box(width=0.2, height=0.2, fixed=True)
    parts = [builder.add_box(width=0.2, height=0.2, position=(x, 0)) for x in (1.0, 2.0, 3.0)]
    builder.add_fixed_joint(post, parts[0], at=(0.5, 0))
    builder.add_prismatic_joint(post, parts[1], at=(1, 0), axis_angle=0.0)
    builder.add_revolute_joint(post, parts[2], at=(1.5, 0))
    world = builder.build()
    state = Engine(CAPACITY).initial_state(*world)
    angle = jnp.asarray(state.angle).at[jnp.array(parts)].set(jnp.array([0.1, 2 * math.pi - 0.2, 0.3]))
    turns = measure.joint_turns(world.scene, dataclasses.replace(state, angle=angle))
    assert np.asarray(turns) == pytest.approx([0.1, 0.2, 0, 0, 0], abs=1e-5)


def test_packed_worlds_count_alike_inside_jit_and_sorted() -> None:
    engine = Engine(CAPACITY)
    worlds = [bar_between_posts(apart) for apart in (0.0, 0.5)] * 3
    scene = stack_worlds([world.scene for world in worlds])
    start = stack_worlds([engine.initial_state(*world) for world in worlds])
    packed_scene, packed, order = engine.pack_sorted(scene, start)

    @jax.jit
    def counts(packed_scene, packed):
        return engine.step_packed(packed_scene, packed, engine.no_controls(6), 10)[1]

    assert order.restore(counts(packed_scene, packed)).open_joints.tolist() == [0, 2] * 3
