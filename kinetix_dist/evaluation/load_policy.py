"""A trained policy from a checkpoint: the network it describes and the parameters it stores.

Parameters do not depend on the size of a level (the transformer treats a world as a set), so a policy trained on one
size plays levels of another. A flat network has fixed inputs, and a mismatch names the array that differs.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist import prng
from kinetix_dist.checkpoint import Checkpoint, select_arrays, unflatten_arrays
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.level import Level
from kinetix_dist.models.policy import PolicyConfig, make_policy

# Where a checkpoint's arrays keep the parameters of the policy, and their average over updates where there is one.
PARAMS_PREFIX = "learner/params"
AVERAGE_PREFIX = "learner/average"


def released_arrays(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """The parameters for use, by path: `LearnerState.released`."""
    return select_arrays(checkpoint.arrays, AVERAGE_PREFIX) or select_arrays(checkpoint.arrays, PARAMS_PREFIX)


def load_policy(checkpoint: Checkpoint, config: PolicyConfig, env: Environment, levels: Level) -> tuple[Any, Any]:
    """(flax module, params) of a checkpoint for playing `levels` in `env`.

    Raises `ArrayMismatchError`, a ValueError that names the array, when the parameters are those of another network.
    """
    module = make_policy(config, env.action_distribution.head_sizes)
    one_level = jax.tree.map(lambda x: x[:1], levels)

    def init(key: Any) -> Any:
        prepared = env.prepare(one_level)
        return module.init(key, env.observe(prepared, prepared.initial_obs))

    template = jax.eval_shape(init, prng.key(0))
    # JAX refuses arrays of numpy as constants of a program ("non-canonical constant") behind a custom gradient.
    return module, jax.tree.map(jnp.asarray, unflatten_arrays(template, released_arrays(checkpoint)))
