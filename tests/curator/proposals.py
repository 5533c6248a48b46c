"""Proposals of curricula for groups of worlds, for tests."""

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.level_buffer import Candidates, keep_best, scored
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.level import SIZES
from tests.curator.made import curriculum_of

CAPACITY = SIZES["s"]
GROUPS, PER_GROUP = 4, 4


def _nothing_solves_itself(levels):
    return jnp.zeros(levels.position.shape[0], bool)


def propose(config, groups, buffer=None, fixed_levels=None):
    tools = {"solves_itself": _nothing_solves_itself, "load_levels": lambda name: fixed_levels}
    curriculum = curriculum_of(config, PER_GROUP, capacity=CAPACITY, **tools)
    groups = jnp.asarray(groups)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(3), groups)
    return jax.jit(curriculum.propose)(buffer, keys, groups).levels


def buffer_of(seed, num_solved, num_finished):
    """Random levels, of which it was seen how many episodes were solved."""
    size = len(num_solved)
    levels = generate_levels(jax.random.key(seed), size, CAPACITY, CurriculumConfig().generator)
    counts = np.array(num_solved), np.full(size, num_finished)

    def pick(slots):
        return jax.tree.map(lambda x: x[slots], levels)

    candidates = Candidates(np.arange(size), *counts, np.zeros((size, 1), np.uint8))
    return keep_best([scored(candidates, pick, size=size, policy_version=0)], size)
