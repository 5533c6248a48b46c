"""Pairs of worlds that play the same fresh level: the learnability of fresh levels, the control of a buffer.

A fresh level is played by one world, and one attempt says nothing of p (1 - p). So one level of each group, drawn
uniformly among its fresh ones, is also played by the next fresh world, whose own level is left out. Actions of the two
are drawn independently, each world has one attempt (`actors/outcomes.py`): of s solved attempts s (2 - s) / 2 has the
mean p (1 - p). A group has one distinct fresh level less.

Every fresh world plays the copy equally often, so that the shares of sizes and the solve rate of fresh levels have
the same means as without pairs. Pairs lie within groups: they do not depend on how groups are spread over devices.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.level.level import Level

NO_COPY = -1  # in `Proposal.copy_of`: the world has a level of its own
PAIR = 3  # folded into a group's key; 0 and 1 are its split, 2 draws the edits of ACCEL


def with_pair(group_keys: Array, levels: Level, num_before: int = 0) -> tuple[Level, Array | None]:
    """(fresh levels, one of each group there twice; `Proposal.copy_of` of all worlds, [groups * (num_before + n)]).

    levels: [groups, n, ...], those of the last n worlds of each group. num_before: worlds of a group before them. Below
    two fresh levels a group there are no pairs: None. Does not consume `group_keys` [groups].
    """
    num_groups, num_fresh = jax.tree.leaves(levels)[0].shape[:2]
    if num_fresh < 2:
        return levels, None
    keys = jax.vmap(prng.fold_in, (0, None))(group_keys, PAIR)
    original = jax.vmap(lambda key: prng.randint(key, (1,), 0, num_fresh))(keys)  # [groups, 1]
    world = jnp.arange(num_fresh)
    is_copy = world == (original + 1) % num_fresh
    plays = jnp.where(is_copy, original, world)  # [groups, n] which of the levels
    own = jnp.full((num_groups, num_before), NO_COPY, jnp.int32)
    copy_of = jnp.concatenate([own, jnp.where(is_copy, num_before + original, NO_COPY)], axis=1)
    levels = jax.vmap(lambda of_group, index: jax.tree.map(lambda x: x[index], of_group))(levels, plays)
    return levels, copy_of.reshape(-1)


def is_copy(copy_of: Array | None) -> Array | bool:
    """[W] bool, of worlds that play the level of another one too; False where there are no pairs."""
    return False if copy_of is None else copy_of != NO_COPY


def pair_learnability(num_pairs: np.ndarray) -> float:
    """Mean p (1 - p) of the levels of pairs, without bias; nan without a pair. num_pairs: [3], with 0, 1 and 2 solved.

    The two attempts differ with the chance 2 p (1 - p)."""
    total = num_pairs.sum()
    return float(num_pairs[1] / (2 * total)) if total else np.nan
