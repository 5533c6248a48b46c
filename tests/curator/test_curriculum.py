"""Proposals of curricula: a share from the buffer, the rest fresh, the same however worlds are spread."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.level.generator import generate_levels
from tests.curator.made import curriculum_of
from tests.curator.proposals import CAPACITY, GROUPS, PER_GROUP, buffer_of, propose


@pytest.fixture(scope="module")
def buffer():
    return buffer_of(0, [1] * 6, 2)


def _is_in(level_positions, positions):
    return (np.abs(np.asarray(level_positions)[:, None] - np.asarray(positions)[None]).max(axis=(2, 3)) == 0).any(
        axis=1
    )


def test_sfl_takes_its_share_of_every_group_from_the_buffer(buffer):
    levels = propose(CurriculumConfig(buffer_share=0.5), range(GROUPS), buffer)
    from_it = _is_in(levels.position, buffer.levels.position).reshape(GROUPS, PER_GROUP)
    np.testing.assert_array_equal(from_it, np.tile([True, True, False, False], (GROUPS, 1)))


@pytest.fixture(scope="module")
def mixed_buffer():
    """Two levels of which something is known to be learned, and four that are always solved."""
    return buffer_of(5, [4, 1, 4, 4, 2, 4], 4)


def test_sfl_plays_measures_and_probes_all_levels_of_its_buffer(mixed_buffer):
    config = CurriculumConfig()
    played = propose(config, range(30), mixed_buffer).position.reshape(30, PER_GROUP, -1)[:, :2].reshape(60, -1)
    slots = {int(np.abs(mixed_buffer.levels.position.reshape(6, -1) - one).sum(1).argmin()) for one in played}
    assert slots == set(range(6))
    curriculum = curriculum_of(config, PER_GROUP, capacity=CAPACITY)
    assert float(curriculum.metrics(mixed_buffer, 3)["curriculum/learnability"]) == pytest.approx((0.25 + 0.1875) / 6)
    assert set(curriculum.probe(mixed_buffer, 6).index.tolist()) == set(range(6))


def test_domain_randomization_repeats_one_level_of_each_group_and_no_other():
    """That of its pair, see `fresh_pairs.py`."""
    levels = propose(CurriculumConfig(name="domain_randomization"), range(GROUPS))
    positions = np.asarray(levels.position).reshape(GROUPS, PER_GROUP, -1)
    assert [len(np.unique(group, axis=0)) for group in positions] == [PER_GROUP - 1] * GROUPS
    assert len(np.unique(positions.reshape(GROUPS * PER_GROUP, -1), axis=0)) == GROUPS * (PER_GROUP - 1)


def test_levels_that_solve_themselves_are_left_out_while_there_are_others():
    def draw(is_trivial):
        def solves_itself(levels):
            return is_trivial & (jnp.arange(levels.position.shape[0]) < 2)

        config = CurriculumConfig(name="domain_randomization")
        curriculum = curriculum_of(config, PER_GROUP, capacity=CAPACITY, solves_itself=solves_itself)
        return jax.jit(lambda keys: curriculum.tools.draw_fresh(keys, PER_GROUP))(jax.random.key(3)[None])

    plain, filtered = draw(False), draw(True)
    np.testing.assert_allclose(filtered.position[:2], plain.position[2:], rtol=1e-5)  # of another program


def test_fixed_levels_are_spread_evenly_over_worlds():
    levels = generate_levels(jax.random.key(1), 3, CAPACITY, CurriculumConfig().generator)
    config = CurriculumConfig(name="fixed", levels="some")
    played = propose(config, range(GROUPS), buffer=levels, fixed_levels=levels)
    np.testing.assert_array_equal(played.position, np.asarray(levels.position)[np.arange(GROUPS * PER_GROUP) % 3])


def test_a_share_that_is_no_whole_number_of_worlds_is_refused():
    with pytest.raises(ValueError, match=r"buffer_share 0\.3 of 4 worlds a group is 1\.2"):
        curriculum_class(CurriculumConfig(buffer_share=0.3), 4)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"name": "plr2"}, "did you mean 'plr'"),
        ({"name": "fixed"}, "level set is needed"),
        ({"num_candidates": 10, "scoring_batch": 4}, "not a multiple of scoring_batch"),
        ({"num_candidates": 8, "scoring_batch": 4, "buffer_size": 9}, "larger than num_candidates 8"),
        ({"adopt_after": 200}, "larger than refresh_every 128"),
        ({"buffer_share": 0.0}, "must be above 0"),
    ],
)
def test_a_curriculum_that_cannot_run_is_refused_with_its_numbers(fields, message):
    with pytest.raises(ValueError, match=message):
        curriculum_class(CurriculumConfig(**fields), PER_GROUP)
