"""Levels of several sizes in arrays of one: what is drawn, in which shares, and that a padded level stays the same."""

import jax
import numpy as np
import pytest

from jax2d.fields import as_dict
from jax2d.scene import stack_worlds
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.fresh_levels import fresh_levels
from kinetix_dist.level.fit import LevelSizeError, capacity_of, fit_level, pad_levels, size_numbers, smallest_size
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.level.size_mixture import check_weights, counts_of, generate_mixture

CONFIG = GeneratorConfig(num_proposals=1, num_proposals_s=1)
MIXTURE = (("m", 1.0), ("s", 3.0))


@pytest.fixture(scope="module")
def designed():
    """Levels of each size, one by one."""
    batches = [load_level_set(f"designed_{size}", size)[0] for size in SIZES]
    return [jax.tree.map(lambda x, i=i: x[i], batch) for batch in batches for i in range(len(batch.position))]


@pytest.mark.parametrize("size", ["m", "l"])
def test_a_padded_batch_holds_what_fitting_level_by_level_gives(designed, size):
    small = [level for level in designed if capacity_of(level) == SIZES["s"]]
    fitted = stack_worlds([fit_level(level, SIZES[size]) for level in small])
    padded = jax.jit(lambda levels: pad_levels(levels, SIZES[size]))(stack_worlds(small))
    ours, theirs = as_dict(padded), as_dict(fitted)
    for name in theirs:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
        assert ours[name].dtype == theirs[name].dtype, name


def test_circles_joints_and_thrusters_find_their_shapes_again(designed):
    """The first circle is shape 5 in S arrays and shape 12 in L arrays."""
    level = next(
        level
        for level in designed
        if capacity_of(level) == SIZES["s"] and (np.asarray(level.scene.joints.b)[level.scene.joints.active] >= 5).any()
    )
    fitted = fit_level(level, SIZES["l"])
    for joint in np.flatnonzero(level.scene.joints.active):
        for end in ("a", "b"):
            before, after = (int(getattr(one.scene.joints, end)[joint]) for one in (level, fitted))
            assert after == (before if before < 5 else before - 5 + 12)
            np.testing.assert_array_equal(fitted.position[after], level.position[before])


def test_arrays_with_less_room_are_refused(designed):
    large = stack_worlds([level for level in designed if capacity_of(level) == SIZES["l"]])
    with pytest.raises(LevelSizeError, match="levels have room for 12 polygons, the larger capacity for 5"):
        pad_levels(large, SIZES["s"])


def test_the_size_of_a_level_is_the_smallest_that_it_fits(designed):
    in_large = stack_worlds([fit_level(level, SIZES["l"]) for level in designed])
    expected = [list(SIZES).index(smallest_size(level)) for level in designed]
    assert set(expected) == {0, 1, 2}
    np.testing.assert_array_equal(jax.jit(size_numbers)(in_large), expected)


def test_counts_are_shares_in_whole_levels():
    assert counts_of((("l", 0.3), ("s", 0.2), ("m", 0.5)), 128) == (("s", 26), ("m", 64), ("l", 38))
    assert counts_of((("s", 2.0), ("m", 0.0), ("l", 6.0)), 8) == (("s", 2), ("l", 6))
    assert counts_of((("m", 1.0),), 3) == (("m", 3),)
    for number in range(3, 40):
        counts = dict(counts_of((("s", 1.0), ("m", 1.0), ("l", 1.0)), number))
        assert sum(counts.values()) == number and max(counts.values()) - min(counts.values()) <= 1


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ((("xl", 1.0),), "has 'xl'; sizes are s, m, l"),
        ((("s", -0.5), ("m", 1.0)), "gives 's' the weight -0.5; weights must be 0 or more"),
        ((("s", 0.0), ("m", 0.0)), "gives all sizes the weight 0"),
        ((("s", 1.0), ("s", 2.0)), "has 's' twice"),
    ],
)
def test_weights_that_mean_nothing_are_refused(weights, message):
    with pytest.raises(ValueError, match=message):
        check_weights("sizes", weights)
    with pytest.raises(ValueError, match=message):
        CurriculumConfig(sizes=weights)


def test_a_weight_that_is_not_finite_is_refused():
    for check in (lambda weights: check_weights("sizes", weights), lambda weights: CurriculumConfig(sizes=weights)):
        with pytest.raises(ValueError, match="sizes"):
            check((("s", float("nan")),))


def test_a_size_that_would_have_no_level_is_refused():
    sizes = (("s", 0.9), ("m", 0.1))
    with pytest.raises(ValueError, match="of 2 levels that are drawn together none would be of size 'm'"):
        curriculum_class(CurriculumConfig(name="domain_randomization", sizes=sizes), 2)
    # SFL draws half of the worlds of a group afresh, and candidates by the batch.
    with pytest.raises(ValueError, match="of 4 levels that are drawn together"):
        curriculum_class(CurriculumConfig(sizes=sizes), 8)
    with pytest.raises(ValueError, match="of 3 levels that are drawn together"):
        curriculum_class(CurriculumConfig(sizes=sizes, num_candidates=3, scoring_batch=3, buffer_size=3), 64)
    for name in ("sfl", "plr", "robust_plr", "accel"):
        curriculum_class(CurriculumConfig(name=name, sizes=sizes), 64)


def test_curricula_that_draw_nothing_have_no_sizes():
    with pytest.raises(ValueError, match="curriculum 'paired' draws no random levels"):
        curriculum_class(CurriculumConfig(name="paired", sizes=MIXTURE), 8)
    with pytest.raises(ValueError, match="curriculum 'fixed' draws no random levels"):
        curriculum_class(CurriculumConfig(name="fixed", levels="s/kick", sizes=MIXTURE), 8)


@pytest.fixture(scope="module")
def groups():
    """Three groups of 8 levels, 6 of size S and 2 of size M, of which every third draw is called trivial."""
    keys = jax.random.split(jax.random.key(3), 3)

    def every_third(levels):
        return np.arange(levels.position.shape[0]) % 3 == 0

    levels = fresh_levels(keys, 8, capacity=SIZES["m"], generator=CONFIG, solves_itself=every_third, sizes=MIXTURE)
    return keys, levels


@pytest.mark.long
def test_fresh_levels_of_a_group_have_the_shares_of_the_mixture(groups):
    keys, levels = groups
    numbers = np.asarray(size_numbers(levels)).reshape(len(keys), 8)
    assert capacity_of(levels) == SIZES["m"]
    assert (numbers[:, :6] == 0).all()  # drawn as S, the smallest first
    assert (numbers[:, 6:] == 1).any()  # drawn as M; one with little in it counts as S


@pytest.mark.long
def test_fresh_levels_are_those_drawn_that_do_not_solve_themselves_size_by_size(groups):
    keys, levels = groups
    drawn = jax.vmap(lambda key: generate_mixture(key, (("s", 12), ("m", 4)), SIZES["m"], CONFIG))(keys)
    is_trivial = np.arange(16) % 3 == 0
    expected = [*np.flatnonzero(~is_trivial[:12])[:6], *(12 + np.flatnonzero(~is_trivial[12:])[:2])]
    np.testing.assert_allclose(levels.position[:8], np.asarray(drawn.position)[0, expected], rtol=1e-5)  # last bits
