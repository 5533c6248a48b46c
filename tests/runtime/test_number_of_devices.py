"""Any number of devices plays the same worlds and makes the same update, evenly divided or not."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from kinetix_dist.recipes import RECIPES, recipe
from kinetix_dist.runtime.processes.placement import PlacementError, check_devices_here, plan_placement
from tests.helpers import REPOSITORY, environment_of_cpus
from tests.runtime.runs import tiny_config

pytestmark = pytest.mark.long

PROGRAM = REPOSITORY / "tests" / "runtime" / "devices_program.py"


@pytest.fixture(
    scope="module",
    params=["most_failed", *(pytest.param(name, marks=pytest.mark.slow) for name in ("paired", "sfl_slices"))],
)
def by_count(request, tmp_path_factory):
    """Arrays by number of devices, of one process that has seven."""
    out = tmp_path_factory.mktemp("devices") / "out.npz"
    command = [sys.executable, str(PROGRAM), str(out), request.param, "1", "7"]
    done = subprocess.run(command, env=environment_of_cpus(7), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    arrays = dict(np.load(out))
    return {
        count: {name.split(":")[1]: x for name, x in arrays.items() if name.startswith(f"{count}:")} for count in (1, 7)
    }


def test_seven_devices_play_the_worlds_of_one(by_count):
    """Levels and actions to the bit, of eight groups."""
    found, expected = by_count[7], by_count[1]
    assert found.keys() == expected.keys()
    names = [name for name in found if name.startswith(("levels/", "actions", "sums/physics"))]
    assert len(names) > 10
    names += [name for name in found if name.startswith("sums/by_source/")]
    if "sums/by_source/fresh_pairs" in found:  # of "sfl_slices": one in each group
        assert found["sums/by_source/fresh_pairs"].sum() == 8
    for name in [*names, "sums/finished", "sums/solved", "sums/failed", "sums/steps"]:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


def test_seven_devices_learn_what_one_learns(by_count):
    found, expected = by_count[7], by_count[1]
    for name in expected:
        if name.startswith(("learner/", "curriculum/")):
            # float32 sums in another order; Adam turns that, where a gradient is near zero, into part of a step of
            # 1e-3, of which there are eight.
            np.testing.assert_allclose(found[name], expected[name], atol=2e-4, rtol=1e-4, err_msg=name)
    for name in ("episodes", "solve_rate", "mean_reward"):
        np.testing.assert_allclose(found[f"metrics/train/{name}"], expected[f"metrics/train/{name}"], rtol=1e-5)


def test_every_number_of_gpus_up_to_64_fits_one_configuration_of_the_larger_recipes():
    config = recipe("sfl_m")
    assert config.num_blocks == 64
    for count in (*range(1, 9), 16, 24, 64):
        placed = dataclasses.replace(config, run=dataclasses.replace(config.run, num_workers=count, device="cpu"))
        assert len(plan_placement(placed, num_gpus=0).of("worker")) == count
        assert placed.hash == config.hash


def test_eight_devices_can_share_every_recipe_but_that_for_tests():
    assert {name for name in RECIPES if recipe(name).num_blocks < 8} == {"tiny"}


def test_more_workers_than_blocks_of_worlds_are_refused_with_what_to_raise():
    config = tiny_config(num_updates=1, placement="colocated", num_workers=5)
    with pytest.raises(PlacementError, match=r"5 workers cannot share 4 blocks .* raise rollout.num_groups 4 and ppo"):
        plan_placement(config, num_gpus=0)


def test_more_devices_of_one_process_than_blocks_of_worlds_are_refused_with_what_to_do():
    config = tiny_config(num_updates=1)
    check_devices_here(config, 4)
    with pytest.raises(PlacementError, match=r"^5 devices cannot share 4 blocks .* raise rollout.num_groups 4"):
        check_devices_here(config, 5)


@pytest.mark.parametrize("count", [1, 3, 4])
def test_rollout_actors_share_all_groups_whatever_their_number(count):
    config = tiny_config(num_updates=1, placement="split", num_rollout_actors=count)
    groups = [group for part in range(count) for group in config.groups_of_part(part, count)]
    assert groups == list(range(config.rollout.num_groups))
