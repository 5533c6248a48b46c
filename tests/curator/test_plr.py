"""PLR's preferences on levels of known difficulty: a level is the chance that the policy solves it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import CurriculumConfig, PlrConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import CurriculumTools
from kinetix_dist.curator.replay_buffer import empty_buffer
from tests.curator.made import curriculum_of, played, stand_in

GROUPS, PER_GROUP, EPISODES, PLACES = 4, 8, 8, 24


class _Tools(CurriculumTools):
    """Fresh levels are solved with a chance that is uniform in [0, 1]."""

    def draw_fresh(self, group_keys, levels_per_group) -> Any:
        return jax.vmap(lambda key: jax.random.uniform(key, (levels_per_group,)))(group_keys).reshape(-1)


def _curriculum(name="plr", **plr):
    config = CurriculumConfig(name=name, plr=PlrConfig(**plr))
    return curriculum_of(config, PER_GROUP, _Tools)


class _Training:
    """A curriculum and the levels it plays, an update at a time."""

    def __init__(self, **plr):
        self.curriculum = _curriculum(**plr)
        self.propose = jax.jit(self._propose)
        self.observe = jax.jit(self._observe)
        self.empty = empty_buffer(stand_in(jnp.zeros(())), PLACES)

    def run(self, num_updates):
        """(state, levels of the buffer that the last quarter of the updates played)."""
        state, replayed = self.empty, []
        for number in range(num_updates):
            proposal = self.propose(state, number)
            state = self.observe(state, proposal, number)
            replayed.append(proposal.levels.reshape(GROUPS, PER_GROUP)[:, : PER_GROUP // 2])
        return state, np.asarray(replayed[-num_updates // 4 :])

    def _propose(self, state, update, groups=tuple(range(GROUPS))):
        key, groups = jax.random.fold_in(jax.random.key(0), update), jnp.asarray(groups)
        return self.curriculum.propose(state, jax.vmap(lambda group: jax.random.fold_in(key, group))(groups), groups)

    def _observe(self, state, proposal, update):
        """After EPISODES of each level."""
        outcome = played(proposal.levels, jax.random.fold_in(jax.random.key(1), update), EPISODES)
        return self.curriculum.observe(state, proposal, outcome)


@pytest.fixture(scope="module")
def by_failure():
    return _Training(score="failure", staleness=0.1)


def test_by_learnability_it_plays_what_is_solved_every_other_time():
    state, replayed = _Training(score="learnability", staleness=0.1).run(40)
    assert state.is_filled.all()
    assert (replayed * (1 - replayed)).mean() > 0.21  # at most 1/4; that of fresh levels is 1/6
    assert np.abs(replayed - 0.5).mean() < 0.17


def test_learnability_is_that_of_a_level_and_not_of_each_world_that_played_it():
    """One episode a world: p (1 - p) of each is 0, whatever the level."""
    training = _Training(score="learnability", staleness=0.1)
    state, _ = training.run(2)
    proposal = training.propose(state, 2)
    outcome = played(proposal.levels, jax.random.key(5), 1)
    solved = jnp.arange(GROUPS * PER_GROUP) % 3 == 0
    outcome = dataclasses.replace(outcome, num_solved=solved.astype(int))
    after = jax.jit(training.curriculum.observe)(state, proposal, outcome)
    slot, is_replayed = np.asarray(proposal.tags["slot"]), ~np.asarray(proposal.tags["is_new"])
    slots = np.unique(slot[is_replayed])
    p = np.array([np.asarray(solved)[is_replayed & (slot == one)].mean() for one in slots])
    assert (p * (1 - p) > 0).any()
    is_there = np.asarray(after.born == state.born)[slots]
    np.testing.assert_allclose(np.asarray(after.score)[slots][is_there], (p * (1 - p))[is_there], atol=1e-6)


def test_by_failure_it_plays_what_is_hardly_ever_solved(by_failure):
    _, replayed = by_failure.run(40)
    assert replayed.mean() < 0.1


def test_by_max_mc_it_plays_what_was_solved_once_and_is_hardly_expected_to_be():
    """The value function is right here: R = 1 once solved, V = p. A level that was never solved scores -p < 0."""
    state, replayed = _Training(score="max_mc", staleness=0.1).run(40)
    assert 0.02 < np.median(replayed) < 0.25
    assert (np.asarray(state.best_return) == 1.0).mean() > 0.9


def test_the_first_update_repeats_its_fresh_levels_and_takes_them_in_once(by_failure):
    proposal = by_failure.propose(by_failure.empty, 0)
    halves = np.asarray(proposal.levels).reshape(GROUPS, 2, PER_GROUP // 2)
    np.testing.assert_array_equal(halves[:, 0], halves[:, 1])
    state = by_failure.observe(by_failure.empty, proposal, 0)
    taken = np.asarray(state.levels)[np.asarray(state.is_filled)]
    np.testing.assert_array_equal(np.sort(taken), np.sort(halves[:, 1].reshape(-1)))


def test_levels_of_a_group_do_not_depend_on_which_other_groups_are_drawn(by_failure):
    state, _ = by_failure.run(3)
    together = by_failure.propose(state, 9)
    apart = [by_failure.propose(state, 9, np.array(groups)) for groups in ((0, 1), (2, 3))]
    jax.tree.map(np.testing.assert_array_equal, together, jax.tree.map(lambda *xs: np.concatenate(xs), *apart))


def test_what_became_of_a_level_that_lost_its_place_changes_nothing_of_the_one_that_took_it(by_failure):
    """A batch is proposed before the one ahead of it was seen, in the split placement."""
    state, _ = by_failure.run(3)
    late = by_failure.propose(state, 3)
    all_born_since = dataclasses.replace(state, born=state.born + 100, score=state.score + 5.0)
    after = by_failure.observe(all_born_since, late, 3)
    np.testing.assert_array_equal(after.score, all_born_since.score)  # new levels score below 5 as well
    np.testing.assert_array_equal(after.last_played, state.last_played)
    assert (by_failure.observe(state, late, 3).last_played > state.last_played).any()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"buffer_share": 1.0}, "buffer_share 1.0 of 8 worlds a group is 8; 'plr' needs worlds of both kinds"),
        ({"plr": PlrConfig(score="beauty")}, "unknown score of levels 'beauty'; choose one of max_mc"),
    ],
)
def test_a_configuration_that_it_cannot_run_with_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        curriculum_class(CurriculumConfig(name="plr", **fields), PER_GROUP)
