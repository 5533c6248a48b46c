"""Curricula that draw levels draw them in the shares of `curriculum.sizes`, whatever else they propose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import CurriculumTools
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.size_mixture import generate_mixture
from tests.curator.made import curriculum_of

pytestmark = pytest.mark.long

CAPACITY = SIZES["m"]
FRESH = 4  # levels that a group draws afresh with each of these: 3 of size S, 1 of size M
SIZES_DRAWN = (("s", 3.0), ("m", 1.0))
WORLDS = {"domain_randomization": 4, "sfl": 8, "plr": 8, "robust_plr": 8, "accel": 16}
GENERATOR = GeneratorConfig(num_proposals=1, num_proposals_s=1)


def _nothing_solves_itself(levels):
    return jnp.zeros(levels.position.shape[0], bool)


class _Unedited(CurriculumTools):
    """Changed levels are the same ones: mutators have tests of their own."""

    def edit(self, keys, levels):
        return levels


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "accel" else []) for name in WORLDS]
)
def test_fresh_levels_of_a_group_have_their_share_of_each_size(name):
    config = CurriculumConfig(name=name, buffer_size=4, sizes=SIZES_DRAWN, generator=GENERATOR)
    given = {"capacity": CAPACITY, "solves_itself": _nothing_solves_itself}
    curriculum = curriculum_of(config, WORLDS[name], _Unedited, **given)
    keys = jax.random.split(jax.random.key(5), 2)
    proposal = curriculum.propose(curriculum.init(), keys, jnp.arange(2))
    fresh_keys = jax.vmap(jax.random.split)(keys)[:, 1]
    # Nothing solves itself: the first half of each size's draw is kept.
    drawn = jax.vmap(lambda key: generate_mixture(key, (("s", 6), ("m", 2)), CAPACITY, GENERATOR))(fresh_keys)
    expected = np.asarray(drawn.position)[:, [0, 1, 2, 6]]
    assert curriculum.num_fresh(config, WORLDS[name]) == FRESH
    found = np.asarray(proposal.levels.position).reshape(2, WORLDS[name], *expected.shape[2:])
    if proposal.copy_of is not None:  # one world of a group plays the level of another one
        copy_of = np.asarray(proposal.copy_of).reshape(2, WORLDS[name])
        assert (copy_of[:, :-FRESH] < 0).all() and (np.sum(copy_of >= 0, axis=1) == 1).all()
        fresh = np.where(copy_of >= 0, copy_of, np.arange(WORLDS[name]))[:, -FRESH:] - (WORLDS[name] - FRESH)
        expected = np.stack([levels[index] for levels, index in zip(expected, fresh, strict=True)])
    np.testing.assert_array_equal(found[:, -FRESH:], expected)  # fresh levels are a group's last
