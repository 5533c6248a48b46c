"""The buffer of Prioritized Level Replay (Jiang et al. 2021, section 3) and the chances with which it is drawn from.

P(i) = (1 - staleness) P_score(i) + staleness P_stale(i)
P_score(i) ~ (1 / rank_i)^(1 / temperature)      rank 1 has the highest score; or alike for the `top_k` best
P_stale(i) ~ c - C_i                             c: now, C_i: when level i was last played, in updates

All worlds of an update are seen at once: first the levels that were played again get their new scores, then new levels
take the slots of the least likely ones, the best new one against the least likely old one and so on, each where its
score is higher. Nothing is added by scattering, which GPUs do in any order: an update that is repeated gives the same
bits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist.checkpoint import select_arrays
from kinetix_dist.curator.config import PlrConfig
from kinetix_dist.curator.scores import UNKNOWN, solve_rate
from kinetix_dist.level.features import FEATURES, features_of_arrays
from kinetix_dist.level.level import Level, select_first
from kinetix_dist.telemetry.curriculum_log import LEVELS

NEVER = -1  # `born` of a slot that holds no level yet


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayBuffer:
    """`K` slots for levels."""

    levels: Level  # [K, ...]
    score: Array  # [K] float32, mean over the worlds that played it when it was last scored
    best_return: Array  # [K] float32, highest return of an episode that ended on the level, UNKNOWN without one
    born: Array  # [K] int32, number of the update that brought the level, or NEVER
    last_played: Array  # [K] int32, number of the update that last played it
    num_updates: Array  # [] int32, observed so far: the number of the next one

    @property
    def is_filled(self) -> Array:
        return self.born != NEVER


def empty_buffer(level: Level, size: int) -> ReplayBuffer:
    """level: any, for shapes and types."""
    return ReplayBuffer(
        levels=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *jnp.shape(x))), level),
        score=jnp.full(size, UNKNOWN, jnp.float32),
        best_return=jnp.full(size, UNKNOWN, jnp.float32),
        born=jnp.full(size, NEVER, jnp.int32),
        last_played=jnp.zeros(size, jnp.int32),
        num_updates=jnp.zeros((), jnp.int32),
    )


def replay_chances(buffer: ReplayBuffer, config: PlrConfig) -> Array:
    """[K] float32, adding up to 1; all zero while the buffer is empty. Equal scores rank in the order of slots."""
    order = jnp.argsort(-buffer.score, stable=True)  # slots without a level come last
    slots = jnp.arange(1, order.size + 1)
    rank = jnp.zeros_like(order).at[order].set(slots, unique_indices=True)
    if config.prioritisation == "rank":
        by_score = (1.0 / rank) ** (1.0 / config.temperature)
    else:
        by_score = (rank <= config.top_k).astype(jnp.float32)
    by_age = (buffer.num_updates - buffer.last_played).astype(jnp.float32)  # at least 1

    def shares(weight: Array) -> Array:
        weight = jnp.where(buffer.is_filled, weight, 0.0)
        return weight / jnp.maximum(weight.sum(), jnp.finfo(jnp.float32).tiny)

    return (1.0 - config.staleness) * shares(by_score) + config.staleness * shares(by_age)


def with_returns(buffer: ReplayBuffer, slot: Array, max_return: Array, is_there: Array) -> tuple[ReplayBuffer, Array]:
    """The buffer with best returns raised by those of this update, and the best return of each world's level [W].

    slot, is_there [W]: as in `played_again`; a world elsewhere has its own max_return [W] alone.
    """
    into = jnp.where(is_there, slot, buffer.score.shape[0])
    best = buffer.best_return.at[into].max(max_return, mode="drop")
    return dataclasses.replace(buffer, best_return=best), jnp.where(is_there, best[slot], max_return)


def level_rates(slot: Array, is_there: Array, num_solved: Array, num_finished: Array, size: int) -> Array:
    """[W] float32, the solve rate of each world's level: the mean over the worlds that played it, UNKNOWN where none
    of them finished an episode.

    slot, is_there [W]: as in `played_again`; a world elsewhere played a level of its own. size: slots of the buffer.
    """
    rate, is_known = solve_rate(num_solved, num_finished), num_finished > 0
    mean, has_any = mean_by_slot(jnp.where(is_there & is_known, slot, size), rate, size)
    pooled = jnp.where(has_any[slot], mean[slot], UNKNOWN)
    return jnp.where(is_there, pooled, jnp.where(is_known, rate, UNKNOWN))


def played_again(buffer: ReplayBuffer, slot: Array, score: Array, is_there: Array) -> ReplayBuffer:
    """New scores of levels that worlds played from the buffer.

    slot [W]: of the level of each world; score [W]; is_there [W] bool: the world played the level that is in that
    slot now. A level that all its worlds say nothing of (UNKNOWN) keeps its score.
    """
    size = buffer.score.shape[0]
    played = jnp.where(is_there, slot, size)
    mean, is_known = mean_by_slot(jnp.where(score > UNKNOWN, played, size), score, size)
    return dataclasses.replace(
        buffer,
        score=jnp.where(is_known, mean, buffer.score),
        last_played=buffer.last_played.at[played].max(buffer.num_updates, mode="drop"),
    )


def taken_in(
    buffer: ReplayBuffer, levels: Level, score: Array, best_return: Array, is_new: Array, config: PlrConfig
) -> ReplayBuffer:
    """The buffer after new levels (is_new [W]) took slots: empty ones first, then the least likely to be played."""
    score = jnp.where(is_new, score, UNKNOWN)
    num_slots = min(score.shape[0], buffer.score.shape[0])
    best = jnp.argsort(-score, stable=True)[:num_slots]
    chance = jnp.where(buffer.is_filled, replay_chances(buffer, config), -1.0)
    slot = jnp.argsort(chance, stable=True)[:num_slots]
    takes = score[best] > buffer.score[slot]

    def put(old: Array, new: Array) -> Array:
        return old.at[slot].set(select_first(takes, new, old[slot]), unique_indices=True)

    now = jnp.full(num_slots, buffer.num_updates, jnp.int32)
    return dataclasses.replace(
        buffer,
        levels=jax.tree.map(lambda old, new: put(old, new[best]), buffer.levels, levels),
        score=put(buffer.score, score[best]),
        best_return=put(buffer.best_return, best_return[best]),
        born=put(buffer.born, now),
        last_played=put(buffer.last_played, now),
    )


def mean_by_slot(slot: Array, value: Array, size: int) -> tuple[Array, Array]:
    """Means of the values [W] of each slot, [size], and whether it had any. A slot of `size` is none.

    Values are added in the order of worlds: a scatter that adds would do so in any order on a GPU.
    """
    order = jnp.argsort(slot, stable=True)
    slot = slot[order]

    def add(left: tuple[Array, ...], right: tuple[Array, ...]) -> tuple[Array, ...]:
        is_same = left[0] == right[0]
        total, count = (jnp.where(is_same, a + b, b) for a, b in zip(left[1:], right[1:], strict=True))
        return right[0], total, count

    value = jnp.where(slot < size, value[order], 0.0)
    _, total, count = jax.lax.associative_scan(add, (slot, value, jnp.ones_like(value)))
    is_last = jnp.append(slot[1:] != slot[:-1], True)
    into = jnp.where(is_last, slot, size)
    mean = jnp.zeros(size, value.dtype).at[into].set(total / count, mode="drop")
    return mean, jnp.zeros(size, bool).at[into].set(True, mode="drop")


def buffer_log(state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of a buffer_*.npz from those of a `ReplayBuffer` by path: slots that hold a level, in order."""
    slot = np.flatnonzero(state["born"] != NEVER)
    levels = {path: array[slot] for path, array in select_arrays(state, "levels").items()}
    return {
        "policy_version": np.asarray(state["num_updates"], np.int32),
        "slot": slot.astype(np.int32),
        **{name: state[name][slot] for name in ("score", "best_return", "born", "last_played")},
        "features": features_of_arrays(levels),
        "feature_names": np.array(FEATURES),
        **{f"{LEVELS}{path}": array for path, array in levels.items()},
    }
