"""ACCEL's preferences on levels of known difficulty: a level is the chance that the policy solves it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import AccelConfig, CurriculumConfig, PlrConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import CurriculumTools
from kinetix_dist.curator.replay_buffer import empty_buffer
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.level import SIZES
from tests.curator.made import curriculum_of, played, stand_in

GROUPS, PER_GROUP, EPISODES, PLACES = 4, 8, 8, 24
EASIEST_HARD = 0.6  # fresh levels are solved more often than this


class _Tools(CurriculumTools):
    """Fresh levels are easy; a child is solved somewhat more or less often than its parent."""

    def draw_fresh(self, group_keys, levels_per_group) -> Any:
        draw = jax.vmap(lambda key: jax.random.uniform(key, (levels_per_group,), minval=EASIEST_HARD))
        return draw(group_keys).reshape(-1)

    def edit(self, keys, levels) -> Any:
        return jnp.clip(levels + jax.vmap(lambda key: jax.random.uniform(key, minval=-0.1, maxval=0.1))(keys), 0, 1)


def _curriculum(name="accel", trivial_above=2.0, **accel):
    config = CurriculumConfig(name=name, plr=PlrConfig(score="failure", staleness=0.1), accel=AccelConfig(**accel))
    return curriculum_of(config, PER_GROUP, _Tools, solves_itself=lambda levels: levels > trivial_above)


def _propose(curriculum, state, update, groups=tuple(range(GROUPS))):
    key, groups = jax.random.fold_in(jax.random.key(0), update), jnp.asarray(groups)
    return curriculum.propose(state, jax.vmap(lambda group: jax.random.fold_in(key, group))(groups), groups)


def _run(curriculum, num_updates):
    """(state, levels that the last quarter of the updates replayed, proposals)"""

    @jax.jit
    def update(state, number):
        proposal = _propose(curriculum, state, number)
        key = jax.random.fold_in(jax.random.key(1), number)
        outcome = played(proposal.levels, key, EPISODES)
        return curriculum.observe(state, proposal, outcome), proposal

    state, proposals = empty_buffer(stand_in(jnp.zeros(())), PLACES), []
    for number in range(num_updates):
        state, proposal = update(state, number)
        proposals.append(np.asarray(proposal.levels).reshape(GROUPS, PER_GROUP))
    return state, np.asarray(proposals[-num_updates // 4 :])[:, :, : PER_GROUP // 2], proposals


def test_it_grows_levels_that_the_generator_never_draws():
    """Scored by failure: children of the hardest are harder still. Robust PLR has only what is drawn."""
    _, grown, _ = _run(_curriculum(), 60)
    _, drawn, _ = _run(_curriculum("robust_plr"), 60)
    assert drawn.min() > EASIEST_HARD - 1e-6
    assert grown.mean() < 0.2 < drawn.mean()


def _children(levels):
    return np.asarray(levels).reshape(GROUPS, PER_GROUP)[:, PER_GROUP // 2 : 3 * PER_GROUP // 4]


def test_a_quarter_of_the_worlds_plays_children_of_what_the_group_replays_from_the_first_update_on():
    """Fresh levels are repeated and changed in the first update."""
    _, _, proposals = _run(_curriculum(edited_share=0.5), 4)
    for levels in proposals:
        replayed, children = levels[:, : PER_GROUP // 2], _children(levels)
        assert (np.abs(children - replayed[:, : children.shape[1]]) <= 0.1 + 1e-6).all()
        assert (children != replayed[:, : children.shape[1]]).all()
        assert (levels[:, 3 * PER_GROUP // 4 :] >= EASIEST_HARD).all()
    fresh = proposals[0][:, 3 * PER_GROUP // 4 :]
    # The same numbers, worked out in two parts of a program: the compiler rounds each in its own way.
    np.testing.assert_allclose(proposals[0][:, : PER_GROUP // 2], np.tile(fresh, 2), rtol=1e-6)


def test_no_fresh_level_is_drawn_that_is_not_played():
    """Twice as many of each kind are drawn as are played: the others solve themselves, or are spare."""
    requested = []

    class Counting(_Tools):
        def draw_fresh(self, group_keys, levels_per_group) -> Any:
            requested.append(levels_per_group)
            return super().draw_fresh(group_keys, levels_per_group)

    config = CurriculumConfig(name="accel", plr=PlrConfig(score="failure"), accel=AccelConfig(edited_share=0.5))
    curriculum = curriculum_of(config, PER_GROUP, Counting, solves_itself=lambda levels: levels > 2.0)
    _propose(curriculum, empty_buffer(stand_in(jnp.zeros(())), PLACES), 0)
    assert requested == [PER_GROUP // 4]


def test_children_that_solve_themselves_are_left_out_while_there_are_others():
    state, _, _ = _run(_curriculum(), 4)
    plain = _children(_propose(_curriculum(), state, 9).levels)
    easiest = plain.max()
    found = _children(_propose(_curriculum(trivial_above=easiest - 1e-6), state, 9).levels)
    assert found.max() < easiest
    others = (plain < easiest).all(1)
    assert others.sum() == GROUPS - 1
    np.testing.assert_array_equal(found[others], plain[others])


def test_levels_of_a_group_do_not_depend_on_which_other_groups_are_drawn():
    curriculum = _curriculum()
    state, _, _ = _run(curriculum, 3)
    together = _propose(curriculum, state, 9)
    apart = [_propose(curriculum, state, 9, groups) for groups in ((0, 1), (2, 3))]
    jax.tree.map(np.testing.assert_array_equal, together, jax.tree.map(lambda *xs: np.concatenate(xs), *apart))


@pytest.mark.long
def test_edited_levels_are_mutated_ones():
    config = CurriculumConfig(name="accel", accel=AccelConfig(num_changes=2))
    tools = curriculum_of(config, PER_GROUP, CurriculumTools, capacity=SIZES["s"]).tools
    levels = generate_levels(jax.random.key(0), 8, SIZES["s"], config.generator)
    children = tools.edit(jax.random.split(jax.random.key(1), 8), levels)
    same = jax.tree.map(lambda a, b: (np.asarray(a) == b).reshape(8, -1).all(1), children, levels)
    assert np.all(jax.tree.leaves(same), axis=0).mean() < 0.3


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: AccelConfig(edited_share=0.0), r"^AccelConfig.edited_share is 0.0; it must be above 0"),
        (lambda: AccelConfig(edited_share=1.0), r"^AccelConfig.edited_share is 1.0; .* and below 1: fresh levels"),
        (lambda: AccelConfig(num_changes=0), r"^AccelConfig.num_changes is 0; it must be 1 or more$"),
        (
            lambda: curriculum_class(CurriculumConfig(name="accel", accel=AccelConfig(edited_share=0.1)), PER_GROUP),
            r"^accel.edited_share 0.1 of 4 new levels a group is 0; 'accel' needs changed levels and fresh ones",
        ),
    ],
)
def test_wrong_settings_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
