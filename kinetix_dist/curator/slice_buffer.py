"""A buffer of levels that is renewed in slices, with what training made of each level since it came in.

    observe, each update    plays of its levels are counted; a level whose last plays say "mastered" or "out of reach"
                            leaves: it is not drawn any more. Fresh levels that were solved are kept as candidates
    adopt, each refresh     a slice of new levels takes the slots of those that left, then of the oldest

A play is the first episode of a world in an update, so that it solves the level with the chance p of the policy, and
plays of a level may be added up (`actors/outcomes.py`). All counts are integers: they are the same however worlds lie
on devices.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.curator.config import SlicesConfig
from kinetix_dist.curator.level_buffer import LevelBuffer
from kinetix_dist.curator.scores import learnability, learnability_now, solve_rate
from kinetix_dist.level.level import Level

IN_USE, MASTERED, OUT_OF_REACH = 0, 1, 2  # `SliceBuffer.status`
NEVER = -1  # `Harvest.solved_at` of a slot without a level


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Harvest:
    """`H` slots for fresh levels that training solved at the first attempt, newest first."""

    levels: Level  # [H, ...]
    solved_at: Array  # [H] int32, number of the update, or NEVER


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class SliceBuffer:
    """`K` levels. R entries of the window: updates in which the level was played, newest first."""

    levels: Level  # [K, ...]
    num_solved: Array  # [K] int32, of the attempts by which it was chosen
    num_finished: Array  # [K] int32, these attempts
    policy_version: Array  # [K] int32, that chose it: with the slot, which level it is
    status: Array  # [K] int8, IN_USE or why it left
    num_plays: Array  # [K] int32, in training since it came in
    window_solved: Array  # [K, R] int32
    window_plays: Array  # [K, R] int32
    last_solved: Array  # [K] int32, of the plays of the last update
    last_plays: Array  # [K] int32
    num_mastered: Array  # [] int32, levels that left so and have been replaced
    num_out_of_reach: Array  # [] int32
    num_replaced: Array  # [] int32, of them all
    num_updates: Array  # [] int32, observed so far
    mean_candidate_score: Array  # [] float32, of the last refresh, over all candidates
    learnable_share: Array  # [] float32, of these, with a score above zero
    harvest: Harvest


def filled(new: LevelBuffer, config: SlicesConfig) -> SliceBuffer:
    """The first buffer, of all that was chosen. Works inside jit."""
    size = new.score.shape[0]
    count = jnp.zeros(size, jnp.int32)
    window = jnp.zeros((size, config.window), jnp.int32)
    number = jnp.zeros((), jnp.int32)
    like = jax.tree.map(lambda x: jnp.asarray(x)[0], new.levels)
    return SliceBuffer(
        levels=new.levels,
        num_solved=new.num_solved,
        num_finished=new.num_finished,
        policy_version=count + new.policy_version,
        status=jnp.full(size, IN_USE, jnp.int8),
        num_plays=count,
        window_solved=window,
        window_plays=window,
        last_solved=count,
        last_plays=count,
        num_mastered=number,
        num_out_of_reach=number,
        num_replaced=number,
        num_updates=number,
        mean_candidate_score=new.mean_candidate_score,
        learnable_share=new.learnable_share,
        harvest=Harvest(
            levels=jax.tree.map(lambda x: jnp.broadcast_to(x, (config.num_harvested, *jnp.shape(x))), like),
            solved_at=jnp.full(config.num_harvested, NEVER, jnp.int32),
        ),
    )


def with_slice(buffer: SliceBuffer, new: LevelBuffer) -> SliceBuffer:
    """`buffer` with new levels in the slots of those that left, the others in those of the oldest. numpy."""
    size = new.score.shape[0]
    oldest_first = np.lexsort((buffer.policy_version, buffer.status == IN_USE))
    slot = oldest_first[:size]
    status = np.asarray(buffer.status)[slot]

    def put(old: Any, values: Any) -> np.ndarray:
        changed = np.array(old)
        changed[slot] = values
        return changed

    return dataclasses.replace(
        buffer,
        levels=jax.tree.map(put, buffer.levels, new.levels),
        num_solved=put(buffer.num_solved, new.num_solved),
        num_finished=put(buffer.num_finished, new.num_finished),
        policy_version=put(buffer.policy_version, new.policy_version),
        status=put(buffer.status, 0),
        num_plays=put(buffer.num_plays, 0),
        window_solved=put(buffer.window_solved, 0),
        window_plays=put(buffer.window_plays, 0),
        last_solved=put(buffer.last_solved, 0),
        last_plays=put(buffer.last_plays, 0),
        num_mastered=np.int32(buffer.num_mastered + (status == MASTERED).sum()),
        num_out_of_reach=np.int32(buffer.num_out_of_reach + (status == OUT_OF_REACH).sum()),
        num_replaced=np.int32(buffer.num_replaced + size),
        mean_candidate_score=new.mean_candidate_score,
        learnable_share=new.learnable_share,
    )


def draw_slots(key: Array, buffer: SliceBuffer, num_levels: int) -> Array:
    """[num_levels] int32, uniformly with replacement among levels in use; among all where every level has left."""
    in_use = buffer.status == IN_USE
    num_in_use = jnp.where(in_use.any(), in_use.sum(), in_use.size)
    in_use_first = jnp.argsort(~in_use, stable=True).astype(jnp.int32)
    return in_use_first[prng.randint(key, (num_levels,), 0, num_in_use)]


def played(buffer: SliceBuffer, slot: Array, solved: Array, is_there: Array, config: SlicesConfig) -> SliceBuffer:
    """After the plays of an update. slot, solved [W] int32: of each world; is_there [W] bool: the world played the
    level that is in that slot now."""
    size = buffer.status.shape[0]
    into = jnp.where(is_there, slot, size)
    count = jnp.zeros(size, jnp.int32)
    num_solved, num_plays = count.at[into].add(solved, mode="drop"), count.at[into].add(1, mode="drop")
    is_played = (num_plays > 0)[:, None]

    def pushed(window: Array, entry: Array) -> Array:
        return jnp.where(is_played, jnp.concatenate([entry[:, None], window[:, :-1]], 1), window)

    window_solved, window_plays = pushed(buffer.window_solved, num_solved), pushed(buffer.window_plays, num_plays)
    recent_solved, recent_plays = recent(window_solved, window_plays, config.window)
    rate = solve_rate(recent_solved, recent_plays)
    verdict = jnp.where(rate > config.leave_above, MASTERED, jnp.where(rate < config.leave_below, OUT_OF_REACH, IN_USE))
    leaves = (buffer.status == IN_USE) & (recent_plays >= config.window)
    return dataclasses.replace(
        buffer,
        status=jnp.where(leaves, verdict, buffer.status).astype(jnp.int8),
        num_plays=buffer.num_plays + num_plays,
        window_solved=window_solved,
        window_plays=window_plays,
        last_solved=num_solved,
        last_plays=num_plays,
        num_updates=buffer.num_updates + 1,
    )


def recent(window_solved: Array, window_plays: Array, num_plays: int) -> tuple[Array, Array]:
    """([K] solved, [K] plays) of the fewest newest updates with `num_plays` plays or more; of all where there are less.

    Updates count as a whole: their plays are of one policy and have no order. [K, R]: newest first."""
    before = jnp.cumsum(window_plays, 1) - window_plays
    counts = before < num_plays
    return (window_solved * counts).sum(1), (window_plays * counts).sum(1)


def harvested(harvest: Harvest, levels: Level, is_solved: Array, num_updates: Array) -> Harvest:
    """Harvest with the levels [W] where `is_solved`, those of update `num_updates`, before older ones."""
    size = harvest.solved_at.shape[0]
    solved_at = jnp.concatenate([jnp.where(is_solved, num_updates, NEVER), harvest.solved_at])
    newest = jnp.argsort(-solved_at, stable=True)[:size]
    return Harvest(
        levels=jax.tree.map(lambda new, old: jnp.concatenate([new, old])[newest], levels, harvest.levels),
        solved_at=solved_at[newest],
    )


def slice_metrics(buffer: SliceBuffer, num_updates: int) -> dict[str, Any]:
    """Metrics curriculum/* after `num_updates` updates, as numpy."""
    now, error = learnability_now(buffer.last_solved, buffer.last_plays)
    num_replaced = np.maximum(buffer.num_replaced, 1)
    is_in_use = buffer.status == IN_USE
    return {
        "curriculum/learnability": learnability(buffer.num_solved, buffer.num_finished).mean(),
        "curriculum/solve_rate": solve_rate(buffer.num_solved, buffer.num_finished).mean(),
        "curriculum/learnable_share": buffer.learnable_share,
        "curriculum/mean_candidate_score": buffer.mean_candidate_score,
        "curriculum/learnability_now": now,
        "curriculum/learnability_now_error": error,
        "curriculum/in_use_share": is_in_use.mean(),
        "curriculum/mastered_share": buffer.num_mastered / num_replaced,
        "curriculum/out_of_reach_share": buffer.num_out_of_reach / num_replaced,
        "curriculum/level_age": (num_updates - buffer.policy_version).mean(),
        "curriculum/plays_per_level": buffer.num_plays.mean(),
    }
