"""Two students on the same levels: of each group of worlds the first half is played by one, the second by the other."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp


@dataclasses.dataclass(frozen=True)
class TwoStudents:
    """A policy, as rollouts take it, of which each half of a group has parameters of its own."""

    policy: Any  # a flax module
    worlds_per_group: int

    @property
    def memory_size(self) -> int:
        return self.policy.memory_size

    def apply(self, params: tuple[Any, Any], *seen: Any) -> Any:
        """Outputs, values and next memory if one is given, [W, ...]. params: of both students; seen: obs, memory."""
        outputs = [
            self.policy.apply(own, *(worlds_of(x, i, self.worlds_per_group) for x in seen))
            for i, own in enumerate(params)
        ]
        return in_groups(*outputs, self.worlds_per_group)


def worlds_of(tree: Any, student: int, worlds_per_group: int) -> Any:
    """[W, ...] -> [W / 2, ...]: those of student 0 or 1."""
    half = worlds_per_group // 2

    def of(x: Any) -> Any:
        num_groups = x.shape[0] // worlds_per_group
        return x.reshape(num_groups, 2, half, *x.shape[1:])[:, student].reshape(num_groups * half, *x.shape[1:])

    return jax.tree.map(of, tree)


def in_groups(first: Any, second: Any, worlds_per_group: int) -> Any:
    """The inverse: what both have, [W / 2, ...] each, as [W, ...]."""
    half = worlds_per_group // 2

    def join(a: Any, b: Any) -> Any:
        num_groups = a.shape[0] // half
        both = jnp.stack([x.reshape(num_groups, half, *x.shape[1:]) for x in (a, b)], axis=1)
        return both.reshape(num_groups * worlds_per_group, *a.shape[1:])

    return jax.tree.map(join, first, second)
