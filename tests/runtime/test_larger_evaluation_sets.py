"""Sets that are larger than what a run trains on are evaluated in arrays of their own size."""

import dataclasses

import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.config import EvaluationConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.evaluate import evaluate
from kinetix_dist.evaluation.evaluation_sets import (
    check_evaluation_sets,
    largest_size_played,
    load_evaluation_set,
    size_played,
)
from kinetix_dist.evaluation.policies import NetworkPolicy, Player, RandomPolicy
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models.policy import NETWORKS, init_params, make_policy
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.cores.evaluator import EVALUATION_STREAM, Evaluator
from kinetix_dist.runtime.processes import gpu_memory

SETS = ("m/car_flip", "s/kick", "s/hop_home")


@pytest.mark.parametrize(
    ("name", "size", "expected"),
    [
        ("random_l", "s", "l"),
        ("random_s", "m", "m"),
        ("s/kick", "s", "s"),
        ("s/kick", "l", "l"),
        ("designed_m", "s", "m"),
        ("dev_designed_l", "m", "l"),
        ("frontier_m", "s", "m"),
    ],
)
def test_a_set_is_played_in_arrays_of_the_run_or_in_its_own(name, size, expected):
    assert size_played(name, size) == expected


def test_the_largest_set_says_how_large_arrays_are():
    assert largest_size_played(("random_s", "random_m"), "s") == "m"
    assert largest_size_played(("random_s",), "l") == "l"
    loaded = load_evaluation_set("m/car_flip", "s")
    assert (loaded.size, loaded.level_names) == ("m", ("car_flip",))
    assert capacity_of(loaded.levels) == SIZES["m"]


def test_networks_say_whether_they_play_all_sizes():
    assert [name for name in NETWORKS if not NETWORKS[name].plays_all_sizes] == ["flat"]
    check_evaluation_sets(("random_l",), "s", "transformer")
    check_evaluation_sets(("random_s",), "s", "flat")
    with pytest.raises(ValueError, match=r"'random_l' does not fit size 's', and policy\.network 'flat' plays"):
        check_evaluation_sets(("random_s", "random_l"), "s", "flat")
    with pytest.raises(ValueError, match="unknown level set 'random_xl'"):
        check_evaluation_sets(("random_xl",), "s", "transformer")


def test_an_evaluator_has_memory_for_its_largest_set():
    config = recipe("sfl_s")
    larger = dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, sets=("random_l",)))
    alone, with_larger = (
        gpu_memory.share_of_gpu(each, [("evaluator", 0)], num_in_group=1).needs[0] for each in (config, larger)
    )
    assert alone.pool_bytes is not None and with_larger.pool_bytes is not None
    of_l = dataclasses.replace(config, env=dataclasses.replace(config.env, size="l"))
    assert with_larger.thread_bytes == gpu_memory.thread_bytes(of_l.env.capacity) > alone.thread_bytes
    assert with_larger.pool_bytes >= alone.pool_bytes


@pytest.mark.long
def test_results_are_those_of_each_size_by_itself():
    base = recipe("tiny")
    env_config = dataclasses.replace(base.env, max_steps=8, frame_skip=32)
    evaluation = EvaluationConfig(sets=SETS, attempts=3, min_attempts=0)
    config = dataclasses.replace(base, env=env_config, evaluation=evaluation)
    env = Environment(config.env)
    module = make_policy(config.policy, env.action_distribution.head_sizes)
    prepared = env.prepare(load_level_set("s/kick", "s")[0])
    params = init_params(module, env.observe(prepared, prepared.initial_obs), prng.key(3))
    together = Evaluator(config, env, module).evaluate(params)
    assert list(together) == list(SETS)
    small = dataclasses.replace(config, evaluation=dataclasses.replace(evaluation, sets=SETS[1:]))
    assert Evaluator(small, env, module).evaluate(params) == {name: together[name] for name in SETS[1:]}
    larger = Environment(dataclasses.replace(env_config, size="m"))
    levels = load_level_set(SETS[0], "m")[0]
    # Three attempts are three worlds of one level each.
    repeated = type(levels)(**{f.name: _thrice(getattr(levels, f.name)) for f in dataclasses.fields(levels)})
    player = Player(NetworkPolicy(module, larger.action_distribution), params)
    alone = evaluate(larger, player, repeated, attempts=1, key=prng.key(EVALUATION_STREAM))
    assert together[SETS[0]]["levels"] == {
        "names": ["car_flip"],
        "solved": [alone.total.solved],
        "attempts": 3,
    }
    by_chance = Evaluator(config, env, module).evaluate(None)
    random = evaluate(
        larger, Player(RandomPolicy(larger.action_space)), repeated, attempts=1, key=prng.key(EVALUATION_STREAM)
    )
    assert by_chance[SETS[0]]["levels"]["solved"] == [random.total.solved]


def _thrice(part):
    import jax

    return jax.tree.map(lambda x: np.repeat(np.asarray(x), 3, axis=0), part)
