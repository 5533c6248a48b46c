"""The 74 public Kinetix levels play: every number stays finite under random actions, and no contact is lost."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from jax2d.scene import stack_worlds
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.records import EnvState
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.kinetix_format import load_kinetix
from kinetix_dist.level.level import SIZES

NUM_STEPS = 60  # 2 s: long enough for everything to fall, collide and be pushed


@pytest.mark.parametrize(("size", "num_levels"), [("s", 10), ("m", 24), ("l", 40)])
def test_public_levels_stay_finite_under_random_actions(public_levels: Path, size: str, num_levels: int) -> None:
    files = sorted((public_levels / size).glob("*.json"))
    assert len(files) == num_levels
    levels = stack_worlds([fit_level(load_kinetix(file), SIZES[size]) for file in files])
    env = Environment(EnvConfig(size=size))
    prepared = env.prepare(levels)

    def advance(env_state: EnvState, key: jax.Array) -> tuple[EnvState, tuple]:
        env_state, obs, reward, _, info = env.step(prepared, env_state, env.action_space.sample(key, num_levels))
        return env_state, (obs.bodies, reward, info)

    unroll = jax.jit(lambda state, keys: jax.lax.scan(advance, state, keys)[1])
    bodies, reward, info = unroll(env.reset(prepared)[0], jax.random.split(jax.random.key(0), NUM_STEPS))
    assert np.isfinite(bodies).all() and np.isfinite(reward).all()
    assert not np.asarray(info.unstable).any()
    overflowing = [file.stem for file, lost in zip(files, np.any(info.contact_overflow, axis=0)) if lost]
    assert not overflowing
