"""The filter of levels that solve themselves, and the setting that switches it off."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.config.train_config import differences, numbers_of
from kinetix_dist.curator import fresh_levels as module
from kinetix_dist.curator.accel import Accel
from kinetix_dist.curator.config import AccelConfig, CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import CurriculumTools
from kinetix_dist.curator.fresh_levels import fresh_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES
from kinetix_dist.recipes import recipe
from tests.curator.made import curriculum_of, stand_in

GROUPS, PER_GROUP = 3, 4
KEYS = jax.random.split(jax.random.key(5), GROUPS)


@pytest.fixture(autouse=True)
def drawn_numbers(monkeypatch):
    """Levels are numbers, in each group 0, 1, 2 and so on: no generator is compiled."""

    def draw(group_keys, number, size, generator, arrays):
        return jnp.tile(jnp.arange(number), (group_keys.shape[0], 1))

    monkeypatch.setattr(module, "_draw", draw)


def _fresh(solves_itself, sizes=()):
    config = GeneratorConfig()
    levels = fresh_levels(
        KEYS, PER_GROUP, capacity=SIZES["m"], generator=config, solves_itself=solves_itself, sizes=sizes
    )
    return np.asarray(levels).reshape(GROUPS, PER_GROUP).tolist()


def test_twice_as_many_are_drawn_and_the_first_that_stay_unsolved_are_kept():
    assert _fresh(lambda levels: levels % 3 == 0) == [[1, 2, 4, 5]] * GROUPS


def test_without_the_filter_all_that_are_drawn_are_kept():
    assert _fresh(None) == [[0, 1, 2, 3]] * GROUPS
    assert _fresh(None, sizes=(("s", 0.5), ("m", 0.5))) == [[0, 1, 0, 1]] * GROUPS


@pytest.mark.parametrize(("is_on", "expected"), [(True, [1, 2, 4, 5]), (False, [0, 1, 2, 3])])
def test_the_setting_switches_it(is_on, expected):
    config = CurriculumConfig(name="domain_randomization", filter_noop=is_on)
    given: dict[str, Any] = (
        {"solves_itself": lambda levels: levels % 3 == 0} if is_on else {}
    )  # where it is off, asking it fails
    curriculum = curriculum_of(config, PER_GROUP, capacity=SIZES["s"], **given)
    proposed = curriculum.tools.draw_fresh(KEYS, PER_GROUP)
    assert np.asarray(proposed).reshape(GROUPS, PER_GROUP).tolist() == [expected] * GROUPS


@pytest.mark.parametrize(("is_on", "expected"), [(True, [1.0, 3.0]), (False, [0.0, 1.0])])
def test_children_of_accel_are_filtered_alike(is_on, expected):
    config = CurriculumConfig(name="accel", filter_noop=is_on, accel=AccelConfig(edited_share=0.5))

    class Tools(CurriculumTools):
        def edit(self, keys, levels):
            return levels

    curriculum = curriculum_of(config, 8, Tools, solves_itself=lambda levels: levels % 2 == 0)
    replayed, fresh = jnp.arange(4.0)[None].repeat(GROUPS, 0), jnp.full((GROUPS, 2), 9.0)
    assert isinstance(curriculum, Accel)
    new = curriculum.new_levels(KEYS, stand_in(replayed), stand_in(fresh))
    assert np.asarray(new).tolist() == [[*expected, 9.0, 9.0]] * GROUPS


def test_it_is_on_unless_it_is_switched_off():
    wrong: Any = 1
    assert CurriculumConfig().filter_noop
    assert curriculum_class(CurriculumConfig(name="sfl", filter_noop=False), PER_GROUP)
    with pytest.raises(ValueError, match="filter_noop"):
        CurriculumConfig(filter_noop=wrong)
    with pytest.raises(ValueError, match="curriculum 'paired' draws no random levels, of which any would be filtered"):
        curriculum_class(CurriculumConfig(name="paired", filter_noop=False), PER_GROUP)


def test_runs_from_before_the_setting_go_on():
    config = recipe("tiny")
    without = dataclasses.replace(config, curriculum=dataclasses.replace(config.curriculum, filter_noop=False))
    assert "filter_noop" not in numbers_of(config)["curriculum"] and without.hash != config.hash
    assert differences(without, config) == ["curriculum.filter_noop False instead of True"]
