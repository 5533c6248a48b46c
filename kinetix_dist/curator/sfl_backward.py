"""SFL that also teaches levels which the policy never solves, backwards from solutions that a search has found.

    refresh   candidates are scored as in `sfl.py`. Some of those that the policy never solved are searched with random
              held actions (`env/held_actions.py`); the solved ones are played again, for the states on their way
    propose   of each group, `buffer_share` of the worlds play the buffer of SFL, `backward.share` levels of the bank
              from their stages on, the others fresh levels. In `backward.shown_share` the solutions of levels of the
              bank act, from the true start on; the policy imitates them
    observe   stages follow one another as they are solved (`proof_bank.py`)

p (1 - p) chooses among what the policy solves sometimes; of what it never solves it says nothing. There, chance knows
more than the policy: a solution of random actions shows that a level can be solved, and where to begin.

A search belongs to one scoring batch and depends on its key alone, so that the bank is the same to the bit however many
processes and devices share a refresh.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.checkpoint import select_arrays
from kinetix_dist.curator.buffer_share import by_group, join_by_group, num_from_buffer, num_of_share
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import CurriculumTools, Proposal
from kinetix_dist.curator.level_buffer import LevelBuffer
from kinetix_dist.curator.proof_bank import (
    NEVER,
    ProofBank,
    Proofs,
    empty_bank,
    levels_of,
    played,
    stage_times,
    with_proofs,
)
from kinetix_dist.curator.sfl import Probe, ScoredBatches, Sfl
from kinetix_dist.env.held_actions import Demonstrations, episode_keys, solved_after, states_on_the_way
from kinetix_dist.level.level import Level
from kinetix_dist.level.walls import empty_level
from kinetix_dist.messages import LevelOutcome

_BANK, _SEARCH = 2, 3  # folded into the key of a group, and of a batch


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class BackwardState:
    """State of the curriculum."""

    buffer: LevelBuffer
    bank: ProofBank
    num_searched: Any  # [] int32, candidates of the last refresh that were searched
    num_proved: Any  # [] int32, of these, with a solution


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Refreshed:
    """Part of a refresh, or all parts of one."""

    scored: Any  # `Scored` of a part, the `LevelBuffer` of all
    proofs: Proofs
    num_searched: Any  # [] int32


class Search(NamedTuple):
    """Search of one batch: its levels [B], and what is known of them."""

    number: np.ndarray  # [n <= B] of the candidates
    levels: Level  # [B, ...], the last one repeated beyond n
    key: Array
    episode: np.ndarray  # [n] int32, of the shortest solution, -1 without one
    num_steps: np.ndarray  # [n] int32, of it


class SflBackward(Sfl):
    """Tags: slot in the bank, `born` of the level there, its stage."""

    observes = True
    sections = ("backward",)
    sources = ("fresh", "searched", "shown")

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self._search = jax.jit(self._search_round)
        self._states = jax.jit(self._states_of)
        self._take = jax.jit(lambda levels, index: jax.tree.map(lambda x: x[index], levels))

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        super().check(config, worlds_per_group)
        num_of_bank = _num_searched(config, worlds_per_group) + _num_shown(config, worlds_per_group)
        if num_of_bank + num_from_buffer(config, worlds_per_group) > worlds_per_group:
            backward = config.backward
            raise ValueError(
                f"curriculum.buffer_share {config.buffer_share}, curriculum.backward.share {backward.share} and "
                f"curriculum.backward.shown_share {backward.shown_share} are more than all worlds together; lower one "
                "of them"
            )
        if config.backward.num_searched > config.scoring_batch:
            raise ValueError(
                f"curriculum.backward.num_searched {config.backward.num_searched} is more than scoring_batch "
                f"{config.scoring_batch}; lower it"
            )

    @classmethod
    def num_fresh(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        num_of_bank = _num_searched(config, worlds_per_group) + _num_shown(config, worlds_per_group)
        return super().num_fresh(config, worlds_per_group) - num_of_bank

    def init(self) -> BackwardState:
        level = jax.tree.map(jnp.asarray, empty_level(self.tools.capacity))
        bank = empty_bank(level, self.tools.config.backward)
        return BackwardState(buffer=super().init(), bank=bank, num_searched=jnp.int32(0), num_proved=jnp.int32(0))

    def propose(self, state: BackwardState | None, group_keys: Array, groups: Array) -> Proposal:
        """A group's worlds are those of the buffer first, then the fresh ones, then those of the bank.

        While the bank is empty its worlds repeat the others.
        """
        base = super().propose(None if state is None else state.buffer, group_keys, groups)
        assert state is not None
        config, size = self.tools.config, self.tools.worlds_per_group
        num_groups, num_searched, num_shown = group_keys.shape[0], _num_searched(config, size), _num_shown(config, size)
        levels, source = by_group((base.levels, base.source), num_groups)
        bank = state.bank
        log_chances = jnp.log(bank.is_filled.astype(jnp.float32))

        def draw(key: Array) -> Array:
            return prng.categorical(prng.fold_in(key, _BANK), log_chances, shape=(num_searched + num_shown,))

        slot = jax.vmap(draw)(group_keys).astype(jnp.int32)
        is_shown = jnp.broadcast_to(jnp.arange(num_searched + num_shown) >= num_searched, slot.shape)
        stage = jnp.where(is_shown, config.backward.num_stages, bank.stage[slot])
        is_empty = ~bank.is_filled.any()
        born = jnp.where(is_shown, NEVER, bank.born[slot])  # what a solution solves says nothing of the policy
        repeated = jnp.arange(num_searched + num_shown) % source.shape[1]
        taught = jax.tree.map(
            lambda new, old: jnp.where(is_empty, old[:, repeated], new), levels_of(bank, slot, stage), levels
        )
        from_bank = jnp.where(is_shown, self.sources.index("shown"), self.sources.index("searched"))
        taught_from = jnp.where(is_empty, source[:, repeated], from_bank)
        nothing = jnp.zeros(source.shape, jnp.int32)
        tags = (
            {"slot": nothing, "born": nothing + NEVER, "stage": nothing},
            {"slot": slot, "born": born, "stage": stage},
        )
        demonstrations = None
        if num_shown:
            none = Demonstrations(keys=jnp.zeros((*source.shape, 2), jnp.uint32), is_shown=nothing.astype(bool))
            of_bank = Demonstrations(keys=bank.keys[slot], is_shown=is_shown & ~is_empty)
            demonstrations = join_by_group(none, of_bank)
        return Proposal(
            levels=join_by_group(levels, taught),
            tags=join_by_group(*tags),
            source=join_by_group(source, taught_from),
            demonstrations=demonstrations,
        )

    def observe(self, state: BackwardState, proposal: Proposal, outcome: LevelOutcome) -> BackwardState:
        bank, tags = state.bank, proposal.tags
        slot, born = tags["slot"], tags["born"]
        # In the split placement a level may have come on, or lost its slot, since it was proposed.
        is_there = (born != NEVER) & (born == bank.born[slot]) & (tags["stage"] == bank.stage[slot])
        bank = played(bank, slot, is_there, outcome.first_solved > 0, self.tools.config.backward)
        return dataclasses.replace(state, bank=bank)

    def refresh_part(
        self, params: Any, policy_version: int, key: Array, part: int, num_parts: int, given: Any = None
    ) -> Refreshed:
        """Every `num_parts`-th batch of the candidates, scored by `params`, and its search."""
        del given
        batches = self.score_batches(params, key, part, num_parts)
        best = self.best_of(batches, policy_version)
        searches = [self._begin(batches, index, key) for index in range(len(batches.number))]
        searches = [search for search in searches if search is not None]
        for number in range(self.tools.config.backward.search_rounds):
            searches = self._rounds(searches, number)
        proofs = [self._proofs(search) for search in searches] or [self._no_proofs()]
        return Refreshed(
            scored=best,
            proofs=_joined(proofs),
            num_searched=np.int32(sum(len(search.number) for search in searches)),
        )

    def join(self, parts: Sequence[Refreshed]) -> Refreshed:
        return Refreshed(
            scored=super().join([part.scored for part in parts]),
            proofs=_joined([part.proofs for part in parts]),
            num_searched=np.int32(sum(int(part.num_searched) for part in parts)),
        )

    def adopt(self, state: BackwardState | None, refreshed: Refreshed) -> BackwardState:
        """A new buffer; new proofs beside those that are being taught."""
        bank = jax.device_get(jax.jit(self.init)()).bank if state is None else state.bank
        return BackwardState(
            buffer=refreshed.scored,
            bank=with_proofs(bank, refreshed.proofs, int(refreshed.scored.policy_version)),
            num_searched=refreshed.num_searched,
            num_proved=np.int32(len(refreshed.proofs.candidate)),
        )

    def metrics(self, state: BackwardState | None, num_updates: int) -> dict[str, Any]:
        if state is None:
            return {}
        bank = state.bank
        is_filled = np.asarray(bank.born) != NEVER
        stage = np.asarray(bank.stage)[is_filled]
        searched = int(state.num_searched)
        return super().metrics(state.buffer, num_updates) | {
            "curriculum/proved_share": int(state.num_proved) / searched if searched else np.nan,
            "curriculum/bank_filled_share": is_filled.mean(),
            "curriculum/bank_stage": stage.mean() if stage.size else np.nan,
            "curriculum/bank_learned": int(bank.num_learned),
            "curriculum/bank_given_up": int(bank.num_given_up),
        }

    @classmethod
    def refresh_log(cls, config: CurriculumConfig, parts: Sequence[Refreshed]) -> dict[str, np.ndarray]:
        return super().refresh_log(config, [part.scored for part in parts])

    @classmethod
    def buffer_log(cls, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray] | None:
        return super().buffer_log(select_arrays(state, "buffer"))

    def probe(self, state: BackwardState | None, num_levels: int) -> Probe | None:
        return super().probe(None if state is None else state.buffer, num_levels)

    def _begin(self, batches: ScoredBatches, index: int, key: Array) -> Search | None:
        """Search of a batch: its first candidates that finished an episode and solved none. None without any."""
        is_never = (np.asarray(batches.num_solved[index]) == 0) & (np.asarray(batches.num_finished[index]) > 0)
        chosen = np.flatnonzero(is_never)[: self.tools.config.backward.num_searched]
        if not len(chosen):
            return None
        number = batches.number[index][chosen]
        batch_key = prng.fold_in(prng.fold_in(key, int(number[0]) // self.tools.config.scoring_batch), _SEARCH)
        levels = self._take(batches.levels[index], np.resize(chosen, self.tools.config.backward.num_searched))
        nothing = np.zeros(len(chosen), np.int32)
        return Search(number, levels, batch_key, nothing - 1, nothing)

    def _rounds(self, searches: Sequence[Search], number: int) -> list[Search]:
        """One round of each search, all of them begun before any is waited for: episodes are shared out evenly among
        the levels without a solution."""
        num_worlds = self.tools.config.backward.search_worlds
        begun = []
        for search in searches:
            unsolved = np.flatnonzero(search.episode < 0)
            if not len(unsolved):
                begun.append(None)
                continue
            level = np.resize(unsolved, num_worlds).astype(np.int32)
            episode = (number * num_worlds + np.arange(num_worlds)).astype(np.int32)
            begun.append((level, episode, self._search(search.levels, search.key, level, episode)))
        return [
            search if one is None else _with_solutions(search, *one[:2], np.asarray(one[2]))
            for search, one in zip(searches, begun, strict=True)
        ]

    def _proofs(self, search: Search) -> Proofs:
        """Solutions of a search, played again. Those that do not solve their level then are left out."""
        size = self.tools.config.backward.num_searched
        level = np.resize(np.arange(len(search.number), dtype=np.int32), size)
        given = level, search.episode[level], search.num_steps[level]
        after, states = jax.device_get(self._states(search.levels, search.key, *given))
        is_proof = (search.episode >= 0) & (after[: len(search.number)] == search.num_steps)
        index = np.flatnonzero(is_proof)
        levels = jax.tree.map(lambda x: np.asarray(x)[index], jax.device_get(search.levels))
        keys = episode_keys(search.key, jnp.asarray(level), jnp.asarray(given[1]))
        return Proofs(
            candidate=search.number[index].astype(np.int32),
            levels=levels,
            states=states[index],
            keys=np.asarray(prng.key_data(keys))[index],
            num_steps=search.num_steps[index],
        )

    def _no_proofs(self) -> Proofs:
        bank = jax.eval_shape(self.init).bank
        of_bank = bank.levels, bank.states, bank.keys
        levels, states, keys = jax.tree.map(lambda x: np.zeros((0, *x.shape[1:]), x.dtype), of_bank)
        none = np.zeros(0, np.int32)
        return Proofs(candidate=none, levels=levels, states=states, keys=keys, num_steps=none)

    def _search_round(self, levels: Level, key: Array, level: Array, episode: Array) -> Array:
        """[W] int32, steps after which episodes [W] solve levels [W] of a batch, 0 where they do not."""
        played_levels = jax.tree.map(lambda x: x[level], levels)
        return solved_after(self.tools.env, played_levels, episode_keys(key, level, episode))

    def _states_of(
        self, levels: Level, key: Array, level: Array, episode: Array, num_steps: Array
    ) -> tuple[Array, Array]:
        """`states_on_the_way` of the same episodes, where the stages of their solutions begin."""
        played_levels = jax.tree.map(lambda x: x[level], levels)
        times = stage_times(num_steps, self.tools.config.backward.num_stages)
        return states_on_the_way(self.tools.env, played_levels, episode_keys(key, level, episode), times)


def _num_searched(config: CurriculumConfig, worlds_per_group: int) -> int:
    """Worlds of a group that play levels of the bank. Raises ValueError where that is not a whole number."""
    return num_of_share("backward.share", config.backward.share, worlds_per_group)


def _num_shown(config: CurriculumConfig, worlds_per_group: int) -> int:
    """Worlds of a group that solutions of the bank play. Raises ValueError where that is not a whole number."""
    return num_of_share("backward.shown_share", config.backward.shown_share, worlds_per_group)


def _with_solutions(search: Search, level: np.ndarray, episode: np.ndarray, after: np.ndarray) -> Search:
    """Search with the shortest solution of each level of a round, the lower episode of two."""
    solved = np.flatnonzero(after)
    order = solved[np.lexsort((episode[solved], after[solved], level[solved]))]
    found, first = np.unique(level[order], return_index=True)
    new_episode, new_steps = search.episode.copy(), search.num_steps.copy()
    new_episode[found], new_steps[found] = episode[order[first]], after[order[first]]
    return search._replace(episode=new_episode, num_steps=new_steps)


def _joined(proofs: Sequence[Proofs]) -> Proofs:
    """All proofs in the order of candidates."""
    every: Proofs = jax.tree.map(lambda *xs: np.concatenate(xs), *proofs)
    order = np.argsort(every.candidate)
    return jax.tree.map(lambda x: x[order], every)
