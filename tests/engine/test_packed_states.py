"""The kernel steps packed states in place where XLA lets it; elsewhere the result is the same."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Capacity, Engine, SceneBuilder, stack_worlds
from jax2d.warp import ffi
from jax2d.warp.variant import CompileOptions, KernelVariant, shared_record

CAPACITY = Capacity(polygons=2, circles=2, joints=1, thrusters=0)
# In a scan XLA for GPUs lets a call write into the stack itself where a moment takes a multiple of 128 bytes.
NUM_WORLDS = 64
NUM_MOMENTS = 5


@functools.cache
def engine() -> Engine:
    return Engine(CAPACITY)


def packed_worlds(one: Engine) -> tuple:
    """Boxes that fall on a floor from different heights, each with a ball that hangs from it."""
    worlds = []
    for number in range(NUM_WORLDS):
        b = SceneBuilder(CAPACITY)
        b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
        box = b.add_box(width=1, height=0.5, position=(0, 0.26 + 0.01 * number), velocity=(1, -1))
        ball = b.add_circle(radius=0.2, position=(0.8, 1.5 + 0.01 * number))
        b.add_revolute_joint(box, ball, at=(0.5, 1))
        worlds.append(b.build())
    scenes = stack_worlds([world.scene for world in worlds])
    states = stack_worlds([one.initial_state(*world) for world in worlds])
    return jax.jit(lambda scenes, states: (one.pack_scene(scenes), one.pack_state(states)))(scenes, states)


def stacked_by_a_scan(one: Engine) -> list[np.ndarray]:
    """The packed state after each of some steps, [NUM_MOMENTS, rows, NUM_WORLDS] a table."""

    @jax.jit
    def simulate(scene, state):
        def body(state, _):
            state, _ = one.step_packed(scene, state, one.no_controls(NUM_WORLDS), num_steps=2)
            return state, state

        return jax.lax.scan(body, state, length=NUM_MOMENTS)[1]

    return [np.asarray(x) for x in jax.tree.leaves(simulate(*packed_worlds(one)))]


@pytest.mark.also_gpu
def test_states_stacked_by_a_scan_are_those_of_single_steps():
    one = engine()
    step = jax.jit(lambda scene, state: one.step_packed(scene, state, one.no_controls(NUM_WORLDS), num_steps=2)[0])
    scene, state = packed_worlds(one)
    moments = []
    for _ in range(NUM_MOMENTS):
        state = step(scene, state)
        moments.append([np.asarray(x) for x in jax.tree.leaves(state)])
    for in_scan, alone in zip(stacked_by_a_scan(one), map(np.stack, zip(*moments)), strict=True):
        np.testing.assert_array_equal(in_scan, alone)
    assert np.abs(alone).max() > 0


@pytest.mark.also_gpu
def test_result_in_other_memory_has_the_same_bits(monkeypatch):
    in_place = stacked_by_a_scan(engine())
    call = ffi._jax_call(KernelVariant.of(CAPACITY, engine().settings, engine().effects))
    assert len(call.input_output_aliases) == 3
    monkeypatch.setattr(call, "input_output_aliases", {})
    for elsewhere, here in zip(stacked_by_a_scan(Engine(CAPACITY)), in_place, strict=True):
        np.testing.assert_array_equal(elsewhere, here)


@pytest.mark.also_gpu
def test_a_state_that_is_kept_is_not_written_over():
    one = engine()
    scene, state = packed_worlds(one)
    before = [np.array(x) for x in jax.tree.leaves(state)]
    jax.block_until_ready(one.step_packed(scene, state, one.no_controls(NUM_WORLDS), num_steps=2))
    for unchanged, now in zip(before, jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(unchanged, np.asarray(now))
    assert jnp.isfinite(state.bodies).all()


@pytest.mark.long
@pytest.mark.also_gpu
@pytest.mark.parametrize("numbers", [5, 8])
def test_what_is_in_shared_memory_changes_no_bit(numbers: int):
    """A CPU has no shared memory: there this shows that the kernel does not depend on it."""
    in_local = stacked_by_a_scan(engine())
    sharing = functools.partial(ffi.WarpBackend, options=CompileOptions(shared_record=numbers))
    for shared, local in zip(stacked_by_a_scan(Engine(CAPACITY, backend=sharing)), in_local, strict=True):
        np.testing.assert_array_equal(shared, local)


def test_shared_memory_is_for_many_small_worlds():
    assert [shared_record(9, worlds) for worlds in (1, 65535, 65536, 1 << 20)] == [0, 0, 8, 8]
    assert shared_record(16, 1 << 20) == shared_record(512, 1 << 20) == 0
