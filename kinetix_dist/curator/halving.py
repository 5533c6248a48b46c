"""Successive halving (Karnin et al. 2013): all candidates are tried a few times, the better ones more often.

    round        0      1      2
    attempts     2      8      24     of a candidate, those of earlier rounds included
    candidates   all    1/3    1/6    the best by p (1 - p), ties by the higher p, then by the lower number

An attempt is the first episode of a world, so that it solves a level with the chance p of the policy, however long
episodes take. Worlds are played in launches of one size, by one program; the rest of the last launch of a round repeats
levels and is not counted. Everything is integer counts but the playing: the order is the same on any device.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng

# (levels' numbers of the worlds of a launch [B], key) -> [B] int32, 1 where the first episode was solved. Asynchronous.
Play = Callable[[Array, Array], Array]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Attempts:
    """Outcomes of n candidates."""

    num_solved: Array  # [n] int32
    num_attempts: Array  # [n] int32
    finalists: Array  # [m] int32, those that played the last round


@dataclasses.dataclass(frozen=True)
class Halving:
    """Rounds for `num_candidates` candidates in launches of as many worlds.

    attempts: after each round, rising. num_in_rounds: candidates that play each round, in the first all."""

    num_candidates: int
    attempts: Sequence[int]
    num_in_rounds: Sequence[int]

    def __call__(self, play: Play, key: Array, *, num_solved: int = 0, num_known: int = 0) -> Attempts:
        """num_solved of num_known: attempts that all candidates had before. Consumes the key."""
        solved = jnp.full(self.num_candidates, num_solved, jnp.int32)
        attempts = jnp.full(self.num_candidates, num_known, jnp.int32)
        chosen, before = jnp.arange(self.num_candidates, dtype=jnp.int32), num_known
        for number, (total, num_kept) in enumerate(zip(self.attempts, self.num_in_rounds, strict=True)):
            if number:
                chosen = _best(solved, chosen, num_kept, before)
            launches = self._launches(play, prng.fold_in(key, number), chosen, total - before)
            if launches:
                solved, attempts = _counted(solved, attempts, chosen, launches, total - before)
            before = total
        return Attempts(num_solved=solved, num_attempts=attempts, finalists=chosen)

    def _launches(self, play: Play, key: Array, chosen: Array, num_attempts: int) -> list[Array]:
        """World after world, `num_attempts` of the first candidate, then of the second and so on."""
        num_worlds = self.num_candidates
        return [
            play(_candidates(chosen, launch, num_worlds, num_attempts), prng.fold_in(key, launch))
            for launch in range(-(-len(chosen) * num_attempts // num_worlds))
        ]


def num_launches(attempts: Sequence[int], num_in_rounds: Sequence[int]) -> int:
    """Number of launches of `num_in_rounds[0]` worlds for one batch of candidates."""
    each = zip([0, *attempts], attempts, num_in_rounds, strict=False)
    return sum(-(-num_kept * (after - before) // num_in_rounds[0]) for before, after, num_kept in each)


@functools.partial(jax.jit, static_argnums=(2, 3))
def _best(solved: Array, chosen: Array, num_kept: int, attempts: int) -> Array:
    """Candidates of highest learnability among `chosen`, which have as many attempts each."""
    chosen = jnp.sort(chosen)
    solved = solved[chosen]
    # Below 2^31 for `MAX_ATTEMPTS`.
    order = jnp.lexsort((-solved, -solved * (attempts - solved)))
    return chosen[order[:num_kept]]


@functools.partial(jax.jit, static_argnums=(2, 3))
def _candidates(chosen: Array, launch: int, num_worlds: int, num_attempts: int) -> Array:
    """[num_worlds] int32, those of the worlds of a launch."""
    world = launch * num_worlds + jnp.arange(num_worlds)
    return chosen[world // num_attempts % chosen.shape[0]]


@functools.partial(jax.jit, static_argnums=4)
def _counted(
    solved: Array, attempts: Array, chosen: Array, launches: list[Array], num_attempts: int
) -> tuple[Array, Array]:
    """The counts [n] with those of a round."""
    num_counted = chosen.shape[0] * num_attempts
    added = jnp.concatenate(launches)[:num_counted].reshape(-1, num_attempts).sum(1, dtype=jnp.int32)
    return solved.at[chosen].add(added), attempts.at[chosen].add(num_attempts)
