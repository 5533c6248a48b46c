"""Recorded rollouts: played by the environment, written, read back, and still the same level and motion."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from jax2d.scene import index_worlds
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.evaluate import evaluate
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.evaluation.recordings import decode_level, encode_level, read_rollouts, record_rollouts
from kinetix_dist.level.level import Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import load_level
from kinetix_dist.telemetry.recording import Rollout
from kinetix_dist.telemetry.sinks.mcap import McapSink
from tests.level.random_levels import random_levels

NUM_LEVELS = 8
MAX_STEPS = 24


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", max_steps=MAX_STEPS))


@pytest.fixture(scope="module")
def levels() -> Level:
    return random_levels("s", NUM_LEVELS)


@pytest.fixture(scope="module")
def rollouts(env: Environment, levels: Level) -> list[Rollout]:
    return record_rollouts(env, Player(RandomPolicy(env.action_space)), levels, jax.random.key(1), seed=1)


def test_a_rollout_starts_where_its_level_does(rollouts: list[Rollout]) -> None:
    for rollout in rollouts:
        level = rollout.level
        active = np.asarray(level.scene.shapes.active)
        np.testing.assert_allclose(rollout.position[0][active], np.asarray(level.position)[active], atol=1e-5)
        np.testing.assert_allclose(rollout.angle[0][active], np.asarray(level.angle)[active], atol=1e-6)


def test_fixed_shapes_stay_and_states_are_finite(rollouts: list[Rollout]) -> None:
    for rollout in rollouts:
        fixed = np.asarray(rollout.level.scene.shapes.inverse_mass) == 0
        np.testing.assert_array_equal(
            rollout.position[:, fixed], rollout.position[:1, fixed].repeat(len(rollout.position), 0)
        )
        assert np.isfinite(rollout.position).all()
        assert np.abs(np.diff(rollout.position, axis=0)).max() < 1.0  # nothing jumps by a metre: no reset inside


def test_recorded_outcomes_are_those_that_evaluation_counts(
    env: Environment, levels: Level, rollouts: list[Rollout]
) -> None:
    rates = evaluate(env, Player(RandomPolicy(env.action_space)), levels, attempts=1, key=jax.random.key(1))
    for rollout, level in zip(rollouts, rates.levels, strict=True):
        assert rollout.num_steps == level.mean_length
        assert (rollout.solved, rollout.failed) == (level.solved == 1, level.failed == 1)
        assert rollout.reward.sum() == pytest.approx(level.mean_return, abs=1e-4)


def test_rollouts_survive_the_file(rollouts: list[Rollout], tmp_path: Path) -> None:
    with McapSink(tmp_path / "a.mcap") as sink:
        for rollout in rollouts:
            assert sink.write(rollout)
    recording = read_rollouts(tmp_path / "a.mcap")
    assert recording.problems == ()
    for read, written in zip(recording.rollouts, rollouts, strict=True):
        np.testing.assert_array_equal(read.position, written.position)
        np.testing.assert_array_equal(read.actions, written.actions)
        same = jax.tree.map(np.array_equal, read.level, written.level)
        assert all(jax.tree.leaves(same))


@pytest.mark.parametrize("size", ["s", "m", "l"])
def test_every_random_level_survives_its_text(size: str) -> None:
    levels = random_levels(size, 32)
    for i in range(32):
        level = index_worlds(levels, i)
        decoded = decode_level(encode_level(level, f"level_{i}", size))
        for part in ("shapes", "joints", "thrusters"):
            ours, theirs = getattr(decoded.scene, part).active, getattr(level.scene, part).active
            assert ours.shape == theirs.shape
            assert ours.sum() == theirs.sum()


def test_a_level_that_was_recorded_with_a_negative_wheel_is_read_as_it_was_played() -> None:
    """Plays a recording made when levels were not turned round: its actions belong to these signs."""
    level, _ = load_level(levels_root() / "s" / "drag_cart.json")
    scene = level.scene.replace(joints={"motor_speed": -level.scene.joints.motor_speed})
    before = dataclasses.replace(level, scene=scene)
    decoded = decode_level(encode_level(before, "drag_cart", "s"))
    np.testing.assert_array_equal(decoded.scene.joints.motor_speed, before.scene.joints.motor_speed)
    assert decoded.scene.joints.motor_speed[0] < 0
