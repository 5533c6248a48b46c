"""The soak counts what goes wrong, and any world of it can be run again by itself."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.soak import EPISODE_STEPS, Soak, Tally
from jax2d import preset
from jax2d.scene import index_worlds

OPTIMISED = True  # worlds alone and among others have the same bits: see tests/conftest.py

FRAME_SKIP = 2
WORLDS = 6


@pytest.fixture(scope="module")
def soak() -> Soak:
    return Soak("s", preset("standard"), FRAME_SKIP, seed=0)


@pytest.mark.long
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


@pytest.mark.long
def test_a_world_run_alone_does_what_it_did_among_others(soak):
    among = soak.play(3, jnp.arange(WORLDS), soak.draw(1, jnp.arange(WORLDS)))
    alone = soak.play(3, jnp.array([5]), soak.draw(1, jnp.array([5])))
    states = [soak.engine.unpack_state(episode.final) for episode in (among, alone)]
    for one, other in zip(jax.tree.leaves(index_worlds(states[0], slice(5, 6))), jax.tree.leaves(states[1])):
        np.testing.assert_array_equal(one, other)
