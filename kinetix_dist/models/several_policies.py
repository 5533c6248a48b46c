"""One network with several sets of parameters: each acts in its share of the worlds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp


@dataclasses.dataclass(frozen=True)
class SeveralPolicies:
    """Policy, as rollouts take it, of which each of equal shares of a group of worlds has parameters of its own."""

    policy: Any  # a flax module
    num_shares: int
    worlds_per_group: int

    @property
    def memory_size(self) -> int:
        return self.policy.memory_size

    def apply(self, params: Sequence[Any], *seen: Any) -> Any:
        """Outputs, values and next memory if one is given, [W, ...]. params: of each share; seen: obs, memory."""
        outputs = [
            self.policy.apply(own, *(share_of(x, i, self.num_shares, self.worlds_per_group) for x in seen))
            for i, own in enumerate(params)
        ]
        return joined_shares(outputs, self.worlds_per_group)


def share_of(tree: Any, number: int, num_shares: int, worlds_per_group: int) -> Any:
    """[W, ...] -> [W / num_shares, ...]: worlds of one share, group by group."""
    size = worlds_per_group // num_shares

    def of(x: Any) -> Any:
        num_groups = x.shape[0] // worlds_per_group
        return x.reshape(num_groups, num_shares, size, *x.shape[1:])[:, number].reshape(num_groups * size, *x.shape[1:])

    return jax.tree.map(of, tree)


def joined_shares(shares: Sequence[Any], worlds_per_group: int) -> Any:
    """The inverse: what all shares have, [W / num_shares, ...] each, as [W, ...]."""
    size = worlds_per_group // len(shares)

    def join(*own: Any) -> Any:
        num_groups = own[0].shape[0] // size
        all_shares = jnp.stack([x.reshape(num_groups, size, *x.shape[1:]) for x in own], axis=1)
        return all_shares.reshape(num_groups * worlds_per_group, *own[0].shape[1:])

    return jax.tree.map(join, *shares)
