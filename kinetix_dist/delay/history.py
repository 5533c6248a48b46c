"""Steps before the present one, which a chunk policy with `FlowConfig.history` above 0 sees besides it.

    before an episode      its first observation, and actions of 0
    then, newest first     what was observed, and the action that was chosen there

In play actions are those that the policy chose: noise that is added later is not seen. In data (windows.py) they are
those that were executed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import PreparedLevels
from kinetix_dist.models.flow_network import Remembered


class History(NamedTuple):
    """The last n steps of W worlds, the newest first."""

    obs: Any  # dynamic, [W, n, ...]
    actions: Array  # [W, n, A] in -1..1


def begun(obs: Any, length: int, num_dimensions: int) -> History:
    """History of worlds whose episodes begin. obs: dynamic, [W, ...]."""
    num_worlds = jax.tree.leaves(obs)[0].shape[0]
    repeated = jax.tree.map(lambda x: jnp.repeat(x[:, None], length, axis=1), obs)
    return History(repeated, jnp.zeros((num_worlds, length, num_dimensions), jnp.float32))


def after(history: History, obs: Any, actions: Array) -> History:
    """History when actions [W, A] were chosen at `obs`."""

    def pushed(new: Array, old: Array) -> Array:
        return jnp.concatenate([new[:, None], old], axis=1)[:, : old.shape[1]]

    return jax.tree.map(pushed, History(obs, actions), history)


def seen(env: Environment, prepared: PreparedLevels, obs: Any, history: History) -> Any:
    """Input of a network: the joined observation, with n above 0 together with the steps before."""
    now = env.observe(prepared, obs)
    if not history.actions.shape[1]:
        return now
    past = jax.vmap(lambda earlier: env.observe(prepared, earlier), in_axes=1, out_axes=1)(history.obs)
    return Remembered(now, past, history.actions)
