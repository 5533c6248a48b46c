"""Which levels a run plays, and an environment for them."""

from __future__ import annotations

import functools

from jax2d.effects import called_for
from kinetix_dist import prng
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.effect_variants import choose_variants
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.level.size_mixture import counts_of, generate_mixture

# Levels from which engines are chosen: a set of effects that 1 % of the levels need is not overlooked.
NUM_SAMPLED = 512


def make_environment(config: TrainConfig) -> Environment:
    """The environment of a run. Where worlds are grouped by effects, its engines suit the levels of the run.

    Every process chooses the same engines: from the levels that the curriculum is given, or from a sample drawn with a
    key of its own.
    """
    if not config.env.effect_groups:
        return _environment(config.env)
    if config.curriculum.levels:
        levels = load_level_set(config.curriculum.levels, config.env.size)[0]
    elif config.curriculum.sizes:
        counts = counts_of(config.curriculum.sizes, NUM_SAMPLED)
        levels = generate_mixture(prng.key(0), counts, config.env.capacity, config.curriculum.generator)
    else:
        levels = generate_levels(prng.key(0), NUM_SAMPLED, config.env.capacity, config.curriculum.generator)
    return Environment(config.env, variants=choose_variants(called_for(levels.scene), config.env.capacity))


@functools.cache
def _environment(config: EnvConfig) -> Environment:
    """One for all parts of a process: each uses what another has compiled."""
    return Environment(config)
