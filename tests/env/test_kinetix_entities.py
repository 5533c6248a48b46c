"""The observation of the public package's policies: the package's own numbers, and what a world of ours becomes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.observations.entities import EntityObs
from kinetix_dist.env.records import PreparedLevels
from kinetix_dist.level.kinetix_format import load_kinetix
from tests.env.worlds import BOX, DISC_1, DISC_2, MOTOR_JOINT, batch, small_level
from tests.kinetix_package import assert_same_observation, observed, run_package, stored_answer, stored_levels

ATOL = 2e-5  # positions of up to 15 m in float32, of shapes stirred far away; the rest agrees to 1e-5 of its value


def test_it_is_what_the_package_computed_of_levels_of_ours() -> None:
    answer = stored_answer()
    assert_same_observation(observed(stored_levels(), answer), answer, atol=ATOL)
    one_way = answer["obs.attention_mask"][:, 3]
    is_hidden_from_the_engine = one_way & answer["obs.attention_mask"][:, 1]
    assert is_hidden_from_the_engine.any()  # joined shapes that overlap: the stored states have some


@pytest.mark.parametrize("size", ["s", "m", "l"])
def test_it_is_what_the_package_computes_of_all_public_levels(size: str, public_levels: Path, tmp_path: Path) -> None:
    files = sorted((public_levels / size).glob("*.json"))
    answer = run_package(tmp_path, {"levels": [str(file) for file in files], "moments": [2, 60, 200], "seed": 0})
    assert_same_observation(observed([load_kinetix(file) for file in files], answer), answer, atol=ATOL)


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", observation="entity_kinetix"))


@pytest.fixture(scope="module")
def observe(env: Environment) -> Callable[[PreparedLevels, Any], EntityObs]:
    return jax.jit(env.observe)


def test_a_disc_that_turns_on_a_box_touches_it_after_the_first_step_alone(
    env: Environment, observe: Callable[..., EntityObs]
) -> None:
    """Disc and box are joined and overlap, so that the engine never lets them collide."""
    level = small_level(box=(1.0, 2.0), disc_1=(1.3, 2.0), joint={**MOTOR_JOINT, "joints.anchor_a": (0.3, 0.0)})
    prepared = env.prepare(batch(level))
    state, obs = env.reset(prepared)
    first = observe(prepared, obs)
    assert not first.attention_masks[0, 3].any()
    _, obs, *_ = env.step(prepared, state, jnp.zeros((1, 6), jnp.int32))
    expected = np.zeros((7, 7), bool)
    expected[DISC_1, BOX] = True  # the circle sees the polygon
    np.testing.assert_array_equal(observe(prepared, obs).attention_masks[0, 3], expected)


def test_joined_shapes_do_not_see_themselves_and_all_do_among_all_shapes(
    env: Environment, observe: Callable[..., EntityObs]
) -> None:
    prepared = env.prepare(batch(small_level(joint=MOTOR_JOINT)))
    obs = observe(prepared, prepared.initial_obs)
    one = np.zeros((7, 7), bool)
    one[BOX, DISC_1] = one[DISC_1, BOX] = True
    active = np.arange(7) != DISC_2
    np.testing.assert_array_equal(obs.attention_masks[0, 2], one)
    np.testing.assert_array_equal(obs.attention_masks[0, 0], active[:, None] & active)
    np.testing.assert_array_equal(obs.attention_masks[0, 1], one | np.diag(active))
    np.testing.assert_array_equal(obs.joint_from[0], [DISC_1, BOX])  # seen from b first
    np.testing.assert_array_equal(obs.joint_to[0], [BOX, DISC_1])


def test_corners_run_clockwise_and_inverse_masses_are_raw(env: Environment, observe: Callable[..., EntityObs]) -> None:
    prepared = env.prepare(batch(small_level()))
    obs = observe(prepared, prepared.initial_obs)
    row = np.asarray(obs.polygons[0, BOX])
    np.testing.assert_allclose(row[4:6], [1 / 0.25, 6 / 0.25**2], rtol=1e-6)
    np.testing.assert_allclose(row[17:25], [-0.25, -0.25, -0.25, 0.25, 0.25, 0.25, 0.25, -0.25])
    circle = np.asarray(obs.circles[0, 0])
    np.testing.assert_allclose(circle[5] / circle[4], 4 / 0.25**2, rtol=1e-6)  # m r^2 / 4


def test_time_may_lead_the_worlds(env: Environment, observe: Callable[..., EntityObs]) -> None:
    """Minibatches of a learner have [T, W, ...] of what moves with [W, ...] of what a level fixes."""
    levels = [small_level(joint=MOTOR_JOINT), small_level(box=(1.2, 1.0))]
    prepared = env.prepare(batch(*levels))
    moved = dataclasses.replace(prepared.initial_obs, has_stepped=jnp.ones(2, bool))
    both = jax.tree.map(lambda x, y: jnp.stack([x, y]), prepared.initial_obs, moved)
    together = observe(prepared, both)
    for t, one in enumerate((prepared.initial_obs, moved)):
        alone = observe(prepared, one)
        jax.tree.map(lambda x, y, t=t: np.testing.assert_array_equal(x[t], y), together, alone)
    assert together.attention_masks.shape == (2, 2, 4, 7, 7)
