"""SFL with a bank of searched levels: what is searched, stages, and the bits of a refresh that is shared."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.actors.outcomes import no_outcomes
from kinetix_dist.curator.config import BackwardConfig, CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.proof_bank import NEVER, empty_bank, played, stage_times
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.walls import empty_level
from tests.curator.made import curriculum_of

GROUPS, PER_GROUP = 2, 8
BACKWARD = BackwardConfig(num_levels=24, num_stages=4, num_searched=12, search_worlds=96, search_rounds=2, min_plays=2)
CONFIG = CurriculumConfig(
    name="sfl_backward", num_candidates=48, scoring_batch=16, buffer_size=6, refresh_every=4, backward=BACKWARD
)


def _play(params, levels, key, num_steps):
    """A policy that solves every fourth level and no other."""
    del params, key, num_steps
    none = no_outcomes(len(levels.angle))
    is_solved = jnp.arange(len(levels.angle)) % 4 == 0
    return dataclasses.replace(none, num_finished=none.num_finished + 2, num_solved=is_solved.astype(jnp.int32))


@pytest.fixture(scope="module")
def curriculum():
    env = Environment(EnvConfig(size="s", max_steps=48))
    return curriculum_of(CONFIG, PER_GROUP, play=_play, env=env, solves_itself=lambda x: jnp.zeros(len(x.angle), bool))


def _refreshed(curriculum, num_parts):
    parts = [curriculum.refresh_part(None, 0, prng.key(1), part, num_parts) for part in range(num_parts)]
    return curriculum.join(parts)


@pytest.fixture(scope="module")
def refreshed(curriculum):
    return _refreshed(curriculum, 1)


@pytest.fixture(scope="module")
def state(curriculum, refreshed):
    return curriculum.adopt(None, refreshed)


def test_levels_that_the_policy_never_solves_are_searched_and_some_have_a_solution(refreshed):
    assert refreshed.num_searched == 36  # 12 of each batch
    candidate = refreshed.proofs.candidate
    assert 3 < len(candidate) < 36 and np.all(np.diff(candidate) > 0) and np.all(candidate % 4 != 0)
    assert np.all(refreshed.proofs.num_steps > 0)


@pytest.mark.parametrize("num_parts", [2, 3])
def test_a_refresh_is_the_same_however_many_share_it(curriculum, refreshed, num_parts):
    jax.tree.map(np.testing.assert_array_equal, _refreshed(curriculum, num_parts), refreshed)


def test_stages_end_at_the_true_start(refreshed):
    proofs = refreshed.proofs
    np.testing.assert_array_equal(stage_times(np.array([9, 3]), 4), [[6, 4, 2, 0], [2, 1, 0, 0]])
    is_there = np.asarray(proofs.levels.scene.shapes.active)
    np.testing.assert_allclose(
        proofs.states[:, -1][is_there][:, :2], np.asarray(proofs.levels.position)[is_there], atol=1e-5
    )


def test_worlds_of_the_bank_begin_at_the_stage_of_their_level(curriculum, state):
    groups = jnp.arange(GROUPS)
    keys = jax.vmap(prng.fold_in, (None, 0))(prng.key(2), groups)
    proposal = jax.jit(curriculum.propose)(state, keys, groups)
    source = np.asarray(proposal.source).reshape(GROUPS, PER_GROUP)
    assert (source[:, :4] >= 2).all() and (source[:, 4:6] == 0).all() and (source[:, 6:] == 1).all()
    slot = np.asarray(proposal.tags["slot"]).reshape(GROUPS, PER_GROUP)[:, 6:]
    position = np.asarray(proposal.levels.position).reshape(GROUPS, PER_GROUP, -1, 2)[:, 6:]
    np.testing.assert_array_equal(position, state.bank.states[slot, 0][..., :2])


def test_without_a_solution_the_other_levels_are_played_twice(curriculum, state):
    bank = dataclasses.replace(state.bank, born=np.full_like(state.bank.born, NEVER))
    groups = jnp.arange(GROUPS)
    keys = jax.vmap(prng.fold_in, (None, 0))(prng.key(2), groups)
    proposal = jax.jit(curriculum.propose)(dataclasses.replace(state, bank=bank), keys, groups)
    position = np.asarray(proposal.levels.position).reshape(GROUPS, PER_GROUP, -1, 2)
    np.testing.assert_array_equal(position[:, 6:], position[:, :2])
    assert (np.asarray(proposal.tags["born"]) == NEVER).all()


def test_the_next_proofs_take_free_slots_first(curriculum, state, refreshed):
    number = len(refreshed.proofs.candidate)
    assert (state.bank.born != NEVER).sum() == number
    later = dataclasses.replace(refreshed, scored=dataclasses.replace(refreshed.scored, policy_version=np.int32(4)))
    bank = curriculum.adopt(state, later).bank
    assert (bank.born == 4).sum() == number and (bank.born == 0).sum() == min(number, 24 - number)


# --- Stages


def _bank(**changes):
    bank = empty_bank(empty_level(Environment(EnvConfig(size="s")).capacity), BACKWARD)
    return dataclasses.replace(bank, born=bank.born.at[:3].set(0), **changes)


@pytest.mark.parametrize(
    ("is_solved", "before", "after"), [((1, 1), 2, 3), ((1, 0), 2, 3), ((0, 0), 2, 1), ((0, 0), 1, 1)]
)
def test_a_stage_that_is_solved_is_followed_by_the_next(is_solved, before, after):
    bank = _bank(stage=jnp.full(24, before))
    bank = played(bank, jnp.array([1, 1]), jnp.ones(2, bool), jnp.array(is_solved), BACKWARD)
    assert bank.stage[1] == after and bank.stage[0] == before and bank.num_plays[1] == 0


def test_one_attempt_is_too_few_to_judge():
    bank = played(_bank(), jnp.array([1]), jnp.ones(1, bool), jnp.array([1]), BACKWARD)
    assert (bank.stage[1], bank.num_plays[1], bank.num_solved[1]) == (1, 1, 1)


def test_what_another_level_did_in_the_slot_does_not_count():
    bank = played(_bank(), jnp.array([1, 1]), jnp.zeros(2, bool), jnp.ones(2, int), BACKWARD)
    assert not bank.num_plays.any() and (bank.stage == 1).all()


def test_a_level_leaves_when_its_true_start_is_solved_and_when_it_does_not_come_on():
    bank = _bank(stage=jnp.full(24, 4))
    bank = played(bank, jnp.array([0, 0]), jnp.ones(2, bool), jnp.ones(2, int), BACKWARD)
    assert bank.born[0] == NEVER and bank.num_learned == 1
    for _ in range(BACKWARD.patience + 1):
        assert bank.born[1] == 0 and bank.num_given_up == 0
        bank = played(bank, jnp.array([1, 1]), jnp.ones(2, bool), jnp.zeros(2, int), BACKWARD)
    assert bank.born[1] == NEVER and bank.num_given_up == 1


# --- Wrong settings


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"share": 0.3}, r"backward.share 0.3 of 8 worlds a group is 2.4, no whole number"),
        ({"share": 0.75}, r"buffer_share 0.5 and curriculum.backward.share 0.75 are more than all worlds"),
        ({"num_searched": 17}, r"num_searched 17 is more than scoring_batch 16; lower it"),
    ],
)
def test_shares_that_do_not_fit_are_refused(changes, line):
    config = dataclasses.replace(CONFIG, backward=dataclasses.replace(BACKWARD, **changes))
    with pytest.raises(ValueError, match=line):
        curriculum_class(config, PER_GROUP)


def test_a_stage_cannot_be_judged_good_and_bad():
    with pytest.raises(ValueError, match=r"retreat_below 0.6 is not below advance_above 0.5"):
        BackwardConfig(retreat_below=0.6)
