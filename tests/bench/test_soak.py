"""The soak counts what goes wrong, and any world of it can be run again by itself."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.soak import EPISODE_STEPS, Soak, Tally, work_at_most
from jax2d import Controls, Engine, SceneBuilder, preset
from jax2d.scene import Capacity, index_worlds

FRAME_SKIP = 2
WORLDS = 6


@pytest.fixture(scope="module")
def soak() -> Soak:
    return Soak("s", preset("standard"), FRAME_SKIP, seed=0)


def test_a_world_that_is_not_finite_is_counted_with_when_and_which(soak):
    levels = soak.draw(0, jnp.arange(WORLDS))
    velocity = np.array(levels.velocity)
    velocity[4, 4] = np.nan  # slots 0 to 3 are the walls
    episode = soak.play(0, jnp.arange(WORLDS), dataclasses.replace(levels, velocity=velocity))
    tally = Tally("s", WORLDS)
    tally.add(0, episode, FRAME_SKIP, settled_after=30)
    assert tally.failures == [{"size": "s", "episode": 0, "world": 4, "action": 0}]
    assert tally.physics_steps == WORLDS * EPISODE_STEPS
    record = tally.record(FRAME_SKIP)
    assert record["not_finite"] == 1
    assert 0.5 < record["fastest_m_s"] < 105.0  # the other worlds fell and were pushed; the limit is 100


def test_a_world_run_alone_does_what_it_did_among_others(soak):
    among = soak.play(3, jnp.arange(WORLDS), soak.draw(1, jnp.arange(WORLDS)))
    alone = soak.play(3, jnp.array([5]), soak.draw(1, jnp.array([5])))
    states = [soak.engine.unpack_state(episode.final) for episode in (among, alone)]
    for one, other in zip(jax.tree.leaves(index_worlds(states[0], slice(5, 6))), jax.tree.leaves(states[1])):
        np.testing.assert_array_equal(one, other)


def test_the_work_of_a_thruster_is_bounded_by_force_times_way():
    capacity = Capacity(polygons=1, circles=0, joints=0, thrusters=1)
    builder = SceneBuilder(capacity, gravity=(0.0, 0.0))
    body = builder.add_box(width=1, height=1, position=(0, 0))
    builder.add_thruster(body, at=(0, 0), angle=0.0, power=3.0)
    world = builder.build()
    engine = Engine(capacity)
    scene = jax.tree.map(lambda x: np.asarray(x)[None], world.scene)
    before = engine.initial_state(scene, *(np.asarray(x)[None] for x in world[1:]))
    controls = Controls(motor=np.zeros((1, 0), np.float32), thruster=np.ones((1, 1), np.float32))
    after, _ = engine.step(scene, before, controls, num_steps=FRAME_SKIP)
    # 30 N for 1/30 s on 1 kg: 1 m/s. From rest the bound is F (v + F t / m) t = 30 x 2 x 1/30 = 2 J for 0.5 J done.
    most = work_at_most(engine.settings, FRAME_SKIP * engine.settings.dt, scene, controls, before, after)
    assert float(after.velocity[0, 0, 0]) == pytest.approx(1.0, rel=1e-5)
    assert float(most[0]) == pytest.approx(2.0, rel=1e-5)
