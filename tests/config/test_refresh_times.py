"""Updates at which refreshes of the curriculum are requested and adopted."""

import dataclasses

import pytest

from kinetix_dist.config import TrainConfig
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.recipes import recipe
from kinetix_dist.setting import ConfigError

STEPS = 128  # of an update of `tiny`
FIXED = {"curriculum.name": "fixed", "curriculum.levels": "designed_s"}


def _config(phases=(), placement="local", **curriculum) -> TrainConfig:
    """Phases by their first updates."""
    config = recipe("tiny")
    return dataclasses.replace(
        config,
        curriculum=dataclasses.replace(config.curriculum, **curriculum),
        run=dataclasses.replace(config.run, placement=placement),
        phases=tuple(PhaseConfig(start=STEPS * first, options=options) for first, options in phases),
    )


def _requests(config, end):
    """(update of the request, batch of the adoption) of each refresh."""
    times = config.refresh_times
    return [(version, times.adopted_at(version)) for version in range(end) if times.is_due(version)]


@pytest.mark.parametrize("placement", ["local", "split"])
def test_the_first_buffer_is_used_at_once_and_later_ones_at_a_fixed_distance(placement):
    config = _config(placement=placement, refresh_every=10, adopt_after=3)
    assert _requests(config, 25) == [(0, 0), (10, 13), (20, 23)]


def test_a_phase_with_other_random_levels_refreshes_as_before():
    options = {"curriculum.generator.triangle_chance": 0.5, "curriculum.filter_noop": False, "ppo.clip": 0.1}
    config = _config([(12, options)], refresh_every=10, adopt_after=3)
    assert _requests(config, 25) == [(0, 0), (10, 13), (20, 23)]
    assert [phase.curriculum_since for phase in config.schedule.phases] == [0, 0]


@pytest.mark.parametrize(("placement", "lag"), [("local", 0), ("split", 1)])
def test_another_state_begins_with_a_refresh_for_its_first_batch(placement, lag):
    """The one requested at 10 would be adopted for batch 13, in which its state is over."""
    config = _config([(12, {"env.size": "m"})], placement, refresh_every=10, adopt_after=3)
    assert _requests(config, 30) == [(0, 0), (12 - lag, 12), (22 - lag, 25 - lag)]
    times = config.refresh_times
    assert [times.is_first(version) for version in (0, 12 - lag, 22 - lag)] == [True, True, False]
    assert [times.number(version) for version in (0, 12 - lag, 22 - lag)] == [0, 0, 1]
    assert [times.next(update) for update in (0, 1, 12 - lag, 13)] == [0, 12 - lag, 12 - lag, 22 - lag]


def test_a_curriculum_without_refreshes_has_none_in_its_phase():
    back = {"curriculum.name": "sfl", "curriculum.levels": ""}
    config = _config([(5, FIXED), (9, back)], refresh_every=3, adopt_after=1)
    assert _requests(config, 14) == [(0, 0), (3, 4), (9, 9), (12, 13)]
    assert config.has_curator and _config([(5, FIXED)]).has_curator
    only_fixed = _config(name="fixed", levels="designed_s")
    assert only_fixed.refresh_times.next(0) is None and not only_fixed.has_curator
    assert _config([(5, back)], name="fixed", levels="designed_s").has_curator


def test_sections_of_a_curriculum_that_comes_later_are_in_the_hash():
    phases = [(4, {"curriculum.name": "plr", "rollout.num_steps": 16})]
    assert _config(phases).hash == _config(phases).hash
    other = dataclasses.replace(_config().curriculum.plr, staleness=0.9)
    assert _config(phases).hash != _config(phases, plr=other).hash
    assert _config().hash == _config(plr=other).hash


def test_a_state_that_would_be_drawn_with_the_first_levels_is_refused():
    with pytest.raises(ConfigError, match=r"phase 1 begins another curriculum at update 1: in placement 'split' its"):
        _config([(1, {"env.size": "m"})], "split")
    assert _config([(1, {"env.size": "m"})]).refresh_times.next(1) == 1


def test_parameters_of_one_size_stay_in_it():
    flat = dataclasses.replace(
        recipe("tiny"),
        env=dataclasses.replace(recipe("tiny").env, observation="flat"),
        policy=dataclasses.replace(recipe("tiny").policy, network="flat"),
    )
    with pytest.raises(
        ValueError, match=r"phase 1: env.size is 'm' after 's', but parameters of policy.network 'flat'"
    ):
        dataclasses.replace(flat, phases=(PhaseConfig(start=500, options={"env.size": "m"}),))
