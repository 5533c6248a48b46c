"""Keywords and options that gymnasium hands on: unknown ones are refused, and each mode of restarting does its part."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, NormalizeObservation
from gymnasium.wrappers.vector import NormalizeObservation as NormalizeVector

import kinetix_dist as kd
from kinetix_dist.env.environment import EnvConfig
from kinetix_dist.env.wrappers.gymnasium_env import KinetixEnv, KinetixVectorEnv
from kinetix_dist.gymnasium_envs import IDS
from kinetix_dist.level.level import Level

MAX_STEPS = 8
FLAT = EnvConfig(observation="flat", max_steps=MAX_STEPS)


@pytest.fixture(scope="module")
def levels() -> Level:
    return kd.load_level_set("designed_s")[0]


@pytest.fixture(scope="module")
def env(levels: Level) -> KinetixEnv:
    return KinetixEnv(FLAT, levels)


@pytest.fixture(scope="module")
def envs(levels: Level) -> KinetixVectorEnv:
    return KinetixVectorEnv(FLAT, levels, num_envs=2)


def test_options_of_the_other_class_are_refused_with_a_suggestion(env: KinetixEnv, envs: KinetixVectorEnv):
    with pytest.raises(ValueError, match=r"^reset has no option 'levels'; did you mean 'level'\?$"):
        env.reset(options={"levels": [3]})
    with pytest.raises(ValueError, match=r"^reset has no option 'level'; did you mean 'levels'\?$"):
        envs.reset(options={"level": 3})
    with pytest.raises(ValueError, match=r"^reset has no option 'x'; it takes 'levels' and 'reset_mask'$"):
        envs.reset(options={"x": 3})


def test_known_options_choose_the_level(env: KinetixEnv, envs: KinetixVectorEnv):
    chosen, _ = envs.reset(options={"levels": [3, 1]})
    assert envs.level_numbers.tolist() == [3, 1]
    np.testing.assert_allclose(env.reset(options={"level": 3})[0], chosen[0], atol=1e-6)  # compiled apart
    for options in (None, {}, {"level": None}):
        env.reset(seed=0, options=options)


def test_keywords_of_make_are_fields_of_the_configuration_or_refused():
    made = gymnasium.make(IDS["s"], levels="designed_s", observation="flat", max_steps=MAX_STEPS)
    assert isinstance(made.unwrapped, KinetixEnv) and made.unwrapped._envs.env.config == FLAT
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(TypeError, match="unexpected keyword argument 'observations'; did you mean 'observation'"):
            make(IDS["s"], levels="designed_s", observations="flat")


@pytest.mark.parametrize("make", [lambda **options: kd.make("s", **options), lambda **o: gymnasium.make(IDS["s"], **o)])
def test_a_number_of_levels_is_refused_where_none_are_drawn(make, levels: Level):
    for chosen in ("designed_s", levels):
        with pytest.raises(ValueError, match=r"^num_levels is 4, but only levels='random' are drawn; leave num_levels"):
            make(levels=chosen, num_levels=4)
    with pytest.raises(ValueError, match=r"^seed is 0, but only levels='random' are drawn; leave seed out$"):
        kd.make("s", levels="designed_s", seed=0)
    with pytest.raises(ValueError, match=r"^num_levels is 4, but 'designed_s' is no random set; leave num_levels out$"):
        kd.load_level_set("designed_s", num_levels=4)


def test_worlds_restart_in_the_next_step(levels: Level):
    """Up to there they step as gymnasium's own vector of single worlds; that one draws other levels then."""
    ours = KinetixVectorEnv(FLAT, levels, num_envs=2, autoreset=AutoresetMode.NEXT_STEP)
    theirs = SyncVectorEnv([lambda: KinetixEnv(FLAT, levels)] * 2, autoreset_mode=AutoresetMode.NEXT_STEP)
    first, _ = ours.reset(options={"levels": [1, 1]})
    theirs.reset(options={"level": 1})
    ended = np.zeros(2, bool)
    while not ended.any():
        obs, rewards, terminations, truncations, infos = ours.step(np.zeros((2, 6), int))
        expected = theirs.step(np.zeros((2, 6), int))
        assert infos.keys() == expected[4].keys()  # values, and masks of the worlds that have them
        np.testing.assert_allclose(obs, expected[0], atol=1e-6)  # compiled apart
        np.testing.assert_allclose(rewards, expected[1], atol=1e-6)
        np.testing.assert_array_equal((terminations, truncations), expected[2:4])
        ended = terminations | truncations
    obs, rewards, terminations, truncations, infos = ours.step(np.ones((2, 6), int))
    np.testing.assert_array_equal(obs, first)
    assert not rewards.any() and not (terminations | truncations).any() and infos == {}
    assert ours.step(np.ones((2, 6), int))[1].any()
    assert ours.autoreset_mode == ours.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP


def test_unknown_modes_of_restarting_are_refused(levels: Level):
    with pytest.raises(ValueError, match=r"^autoreset is 'never'; it can be True, False or one of 'NextStep', "):
        gymnasium.make_vec(IDS["s"], num_envs=1, levels="designed_s", autoreset="never")


def test_observations_are_normalised_when_they_are_one_array(env: KinetixEnv, levels: Level):
    entities = KinetixEnv(EnvConfig(max_steps=MAX_STEPS), levels)
    with pytest.raises(TypeError, match=r'^this wrapper needs one array.* with observation="flat"'):
        NormalizeObservation(entities)
    assert entities.observation_space.shape is None  # for everyone else it is a Dict like any other
    for flat in (env, FlattenObservation(entities)):
        normalised = NormalizeObservation(flat)
        assert normalised.reset(seed=0)[0].shape == normalised.observation_space.shape
    vector = NormalizeVector(KinetixVectorEnv(FLAT, levels, num_envs=2, autoreset=AutoresetMode.NEXT_STEP))
    obs, _ = vector.reset(seed=0)
    assert obs in vector.observation_space


@pytest.mark.parametrize("options", [["level"], "level"])
def test_options_that_are_no_dictionary_are_refused(options: Any, envs: KinetixVectorEnv) -> None:
    with pytest.raises(TypeError, match="give a dictionary"):
        envs.reset(options=options)
