"""vmap over the engine: every mapped world is stepped, and as it is alone. Gradients, and empty batches."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Capacity, Controls, Engine, Scene, SceneBuilder, State, preset, stack_worlds

CAPACITY = Capacity(polygons=0, circles=3, joints=1, thrusters=1)
NUM_STEPS = 3


@functools.cache
def engine(backend: str, name: str = "standard") -> Engine:
    return Engine(CAPACITY, backend=backend, settings=preset(name))


def world(one: Engine, speed: float) -> tuple[Scene, State]:
    """A driven pendulum with a thruster, and a disc that comes at it with the given speed."""
    b = SceneBuilder(CAPACITY)
    post, bob = b.add_circle(radius=0.1, fixed=True), b.add_circle(radius=0.2, position=(0.5, 0), density=1 + speed)
    b.add_circle(radius=0.2, position=(1, 0), velocity=(-speed, 0))
    b.add_revolute_joint(post, bob, at=(0, 0), motor_speed=1.0)
    b.add_thruster(bob, at=(0.6, 0), angle=1.0)
    built = b.build()
    return built.scene, one.initial_state(*built)


def controls(motor: float) -> Controls:
    return Controls(motor=np.full(1, motor, np.float32), thruster=np.ones(1, np.float32))


def stacked(one: Engine, *speeds: float) -> tuple[Scene, State, Controls]:
    scenes, states = zip(*(world(one, speed) for speed in speeds))
    acts = [controls(0.1 * i) for i in range(len(speeds))]
    return stack_worlds(list(scenes)), stack_worlds(list(states)), stack_worlds(acts)


def assert_same(a: Any, b: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


def fold(tree: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x).reshape(x.shape[0] * x.shape[1], *x.shape[2:]), tree)


@pytest.mark.long
@pytest.mark.also_gpu
@pytest.mark.parametrize(
    ("backend", "name"),
    # The step of the reference is mapped over worlds whatever the solver: soft steps compile for a minute more.
    [("warp", "standard"), ("xla", "paper"), pytest.param("xla", "standard", marks=pytest.mark.slow)],
)
def test_nested_vmap_of_single_worlds_is_the_batch(backend: str, name: str):
    one = engine(backend, name)
    step = functools.partial(one.step, num_steps=NUM_STEPS)
    worlds = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), stacked(one, *range(6)))
    nested, batch = fold(jax.jit(jax.vmap(jax.vmap(step)))(*worlds)), jax.jit(step)(*fold(worlds))
    if backend == "warp":
        assert_same(nested, batch)
    else:
        # XLA orders the sums of a program as it likes: float32 rounds speeds of 3 m/s at 2e-7, in 30 passes.
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=5e-6), nested, batch)


@pytest.mark.also_gpu
def test_vmap_of_batches_and_vmap_outside_jit():
    step = functools.partial(engine("warp").step, num_steps=NUM_STEPS)
    worlds = stacked(engine("warp"), *range(6))
    batch = jax.jit(step)(*worlds)
    assert_same(jax.vmap(step)(*worlds), batch)
    batches = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), worlds)
    assert_same(fold(jax.jit(jax.vmap(step))(*batches)), batch)


@pytest.mark.also_gpu
@pytest.mark.parametrize("mapped", ["scene", "state", "controls"])
def test_what_is_not_mapped_holds_for_all(mapped: str):
    step = functools.partial(engine("warp").step, num_steps=NUM_STEPS)
    worlds = dict(zip(("scene", "state", "controls"), stacked(engine("warp"), 0.0, 1.0, 2.0)))
    given = {name: x if name == mapped else jax.tree.map(lambda x: x[1], x) for name, x in worlds.items()}
    axes = [0 if name == mapped else None for name in worlds]
    repeated = [x if name == mapped else stack_worlds([x] * 3) for name, x in given.items()]
    assert_same(jax.jit(jax.vmap(step, axes))(*given.values()), jax.jit(step)(*repeated))


@pytest.mark.also_gpu
def test_vmap_of_a_scan_over_packed_tables():
    one = engine("warp")
    worlds = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), stacked(one, *range(4)))

    def rollout(scene: Scene, state: State, acts: Controls) -> State:
        packed_scene = one.pack_scene(scene)

        def body(packed: Any, _: None) -> Any:
            return one.step_packed(packed_scene, packed, acts)

        return one.unpack_state(jax.lax.scan(body, one.pack_state(state), length=NUM_STEPS)[0])

    assert_same(fold(jax.jit(jax.vmap(rollout))(*worlds)), jax.jit(rollout)(*fold(worlds)))


@pytest.mark.parametrize(
    ("backend", "name", "is_mapped"),
    # Whether the reference's worlds are a batch or mapped over is one program to it: its step is mapped anyway.
    [
        ("warp", "standard", False),
        ("warp", "standard", True),
        ("xla", "paper", False),
        pytest.param("xla", "paper", True, marks=pytest.mark.slow),
        pytest.param("xla", "standard", False, marks=pytest.mark.slow),
    ],
)
def test_a_batch_of_nobody_stays_one(backend: str, name: str, is_mapped: bool):
    one = engine(backend, name)
    empty = jax.tree.map(lambda x: x[:0], stacked(one, 0.0))
    state, touching = (jax.vmap(one.step) if is_mapped else one.step)(*empty)
    assert state.position.shape == (0, CAPACITY.shapes, 2)
    assert touching.overflow.shape == (0,)


def test_gradients_through_the_kernel_name_the_backend_that_has_them():
    one = engine("warp")
    scene, state = world(one, 1.0)

    def height(motor: jax.Array) -> jax.Array:
        return one.step(scene, state, Controls(motor=motor, thruster=jnp.ones(1)))[0].position[1, 1]

    for differentiate in (jax.grad, jax.jacfwd, lambda f: jax.jit(jax.grad(f))):
        with pytest.raises(NotImplementedError, match="'warp' has no gradients; build the engine with backend='xla'"):
            differentiate(height)(jnp.zeros(1))
