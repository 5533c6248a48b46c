"""Solve rates of training against a known p: from steps of worlds to metrics, a line of outcomes.jsonl and the pages.

The worlds are made up: at its begin an episode is solved with the chance p of its level, in 1 step, and runs out of
time otherwise. All that counts them is real.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from kinetix_dist.actors.outcomes import PHYSICS_FIELDS, add_step, no_outcomes
from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.learner.sharding import DATA_AXIS, data_mesh, on_devices
from kinetix_dist.level.level import SIZES
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.runtime.cores.rollout_sums import (
    BY_SOURCE,
    FRESH_PAIRS,
    SIZES_PLAYED,
    attempt_sums,
    attempts_by,
    pairs_by_solved,
    step_sums,
)
from kinetix_dist.runtime.cores.update_metrics import training_metrics
from kinetix_dist.runtime.driver.run_data import OutcomeWindow
from kinetix_dist.studio.runs.refreshes import Refreshes, describe_training, training_plays
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, OUTCOMES
from kinetix_dist.telemetry.json_lines import append_line

MAX_STEPS = 8
NUM_WORLDS = 6000
P_OF_BUFFER = np.array([0.2, 0.5, 0.5, 0.8])
P_OF_FRESH = 0.3
PER_GROUP = 4  # worlds, where there are pairs


class Course(NamedTuple):
    """Course of worlds, [T, W]."""

    done: np.ndarray
    solved: np.ndarray
    failed: np.ndarray
    episode_return: np.ndarray
    episode_length: np.ndarray


def course(
    chance: np.random.Generator, p: np.ndarray, num_steps: int, *, solved_after: int = 1, ended_after: int = MAX_STEPS,
    fails: bool = False,
) -> Course:  # fmt: skip
    """Episodes that are solved with the chance p [W], after so many steps; the others end later, as failed or not."""
    age, is_to_be_solved, rows = np.zeros(len(p), int), chance.random(len(p)) < p, []
    for _ in range(num_steps):
        age += 1
        solved = is_to_be_solved & (age == solved_after)
        done = solved | (~is_to_be_solved & (age == ended_after))
        rows.append(Course(done, solved, done & ~solved & fails, 1.0 * solved - 0.1 * age, age.copy()))
        age = np.where(done, 0, age)
        is_to_be_solved = np.where(done, chance.random(len(p)) < p, is_to_be_solved)
    return Course(*map(np.stack, zip(*rows, strict=True)))


@dataclasses.dataclass(frozen=True)
class Info:
    solved: Any
    failed: Any
    episode_return: Any
    episode_length: Any

    def __getattr__(self, name: str) -> Any:  # counters of the physics
        if name not in PHYSICS_FIELDS:
            raise AttributeError(name)
        return jnp.zeros_like(self.episode_length)


@jax.jit
def outcome_of(course: Course) -> LevelOutcome:
    def step(outcome: LevelOutcome, at: Course) -> tuple[LevelOutcome, None]:
        return add_step(outcome, at.done, Info(*at[1:])), None

    return jax.lax.scan(step, no_outcomes(course.done.shape[1]), course)[0]


def sums_over(outcome: LevelOutcome, source: np.ndarray, size: np.ndarray) -> dict[str, Any]:
    """Sums as a rollout gives them. source: 0 fresh, others a slot of the buffer; size: number of it; of each world."""
    rewards = np.zeros((MAX_STEPS, len(outcome.num_solved)), np.float32)
    return jax.device_get(_sums_over(outcome, rewards, source, size))


@jax.jit
def _sums_over(*given: Any) -> dict[str, Any]:
    def inside(outcome: LevelOutcome, rewards: Any, source: Any, size: Any) -> dict[str, Any]:
        is_counted = jnp.ones(rewards.shape[1], bool)
        by_source = attempts_by(source, outcome, is_counted, 1 + len(P_OF_BUFFER))
        sums = step_sums(outcome, rewards, is_counted) | attempt_sums(outcome, is_counted)
        return sums | {BY_SOURCE: by_source, SIZES_PLAYED: attempts_by(size, outcome, is_counted, len(SIZES))}

    worlds, steps, whole = PartitionSpec(DATA_AXIS), PartitionSpec(None, DATA_AXIS), PartitionSpec()
    mesh = data_mesh(jax.devices()[:1])
    return on_devices(inside, mesh, in_specs=(worlds, steps, worlds, worlds), out_specs=whole)(*given)


@jax.jit
def pairs_of(outcome: LevelOutcome, copy_of: np.ndarray, is_counted: np.ndarray) -> Any:
    """Pairs by how many of both attempts were solved, of groups of PER_GROUP worlds."""

    def inside(*given: Any) -> Any:
        outcome, copy_of, is_counted = given
        return pairs_by_solved(copy_of, outcome, is_counted, PER_GROUP)

    worlds, mesh = PartitionSpec(DATA_AXIS), data_mesh(jax.devices()[:1])
    return on_devices(inside, mesh, in_specs=(worlds, worlds, worlds), out_specs=PartitionSpec())(
        outcome, copy_of, is_counted
    )


def holds(low: float, p: float, high: float) -> bool:
    return low <= p <= high


@pytest.fixture(scope="module")
def update() -> tuple[LevelOutcome, dict[str, Any], dict[str, float]]:
    """(outcome, sums, metrics): half of the worlds play levels of a buffer, half fresh ones; sizes take turns."""
    chance = np.random.default_rng(5)
    place = chance.integers(0, len(P_OF_BUFFER), NUM_WORLDS)
    is_fresh = np.arange(NUM_WORLDS) % 2 == 0
    p = np.where(is_fresh, P_OF_FRESH, P_OF_BUFFER[place])
    outcome = outcome_of(course(chance, p, MAX_STEPS))
    source = np.where(is_fresh, 0, 1 + place)
    size = np.where(is_fresh, 0, 2)
    sums = sums_over(outcome, source, size)
    return outcome, sums, training_metrics(sums, {}, frame_skip=1, sources=("fresh",))


def test_the_made_up_worlds_solve_more_of_all_episodes_than_of_the_first_ones(update) -> None:
    outcome, _, metrics = update
    p = (P_OF_FRESH + P_OF_BUFFER.mean()) / 2
    assert metrics["train/episodes"] == int(outcome.num_finished.sum()) > 1.2 * NUM_WORLDS
    assert outcome.num_solved.sum() / outcome.num_finished.sum() > p + 0.15
    # Of one world alone solved / finished has the mean p: half of the levels are fresh, the others of the buffer.
    per_world = np.asarray(outcome.num_solved / outcome.num_finished)
    assert abs(per_world.mean() - p) < 3 * per_world.std() / np.sqrt(NUM_WORLDS)


def test_solve_rates_of_metrics_are_those_of_first_episodes(update) -> None:
    *_, metrics = update
    assert metrics["train/attempts"] == NUM_WORLDS
    buffer, p = P_OF_BUFFER.mean(), (P_OF_FRESH + P_OF_BUFFER.mean()) / 2
    for name, expected, worlds in (
        ("train/solve_rate", p, NUM_WORLDS),
        ("train/solve_rate_of_fresh", P_OF_FRESH, NUM_WORLDS // 2),
        ("train/solve_rate_of_buffer", buffer, NUM_WORLDS // 2),
        ("train/solve_rate_s", P_OF_FRESH, NUM_WORLDS // 2),
        ("train/solve_rate_l", buffer, NUM_WORLDS // 2),
    ):
        low, high = wilson_interval(round(metrics[name] * worlds), worlds)
        assert holds(low, expected, high), name
    assert np.isnan(metrics["train/solve_rate_m"]) and metrics["train/level_share_l"] == 0.5
    assert metrics["train/failed_rate"] == 0
    # 1 less 0.1 a step: 0.9 where the first episode is solved, else -0.8.
    assert metrics["train/mean_return"] == pytest.approx(0.9 * metrics["train/solve_rate"] - 0.8 * (
        1 - metrics["train/solve_rate"]
    ), abs=1e-5)  # float32, sums over 6,000 worlds  # fmt: skip


@pytest.mark.parametrize(("sources", "num_counted"), [(("all",), 1), ((), 3)])
def test_where_all_levels_come_from_one_source_there_is_one_solve_rate(update, sources, num_counted) -> None:
    """Curricula: "domain_randomization", and "fixed", which counts the levels of its set one by one."""
    _, sums, _ = update
    counts = {name: np.full(num_counted, 4) for name in ("solved", "attempts")}
    metrics = training_metrics(sums | {BY_SOURCE: counts}, {}, frame_skip=1, sources=sources)
    assert not [name for name in metrics if name.startswith("train/solve_rate_of")]


def test_the_line_of_a_window_has_the_learnability_of_its_levels(update, tmp_path: Path) -> None:
    _, sums, metrics = update
    window = OutcomeWindow(every=1)
    (line,) = window.add(1, sums[BY_SOURCE], 0, ("fresh",))
    assert sum(line["attempts"]) + line["sources"]["fresh"]["attempts"] == metrics["train/attempts"]
    training = describe_training(training_plays([line])[0])
    assert holds(training["low"], P_OF_BUFFER.mean(), training["high"])
    # 750 attempts or so at each level: the error of p (1 - p) of one is (1 - 2p) sqrt(p (1 - p) / 750) at most.
    assert training["learnability"] == pytest.approx((P_OF_BUFFER * (1 - P_OF_BUFFER)).mean(), abs=0.01)
    (tmp_path / DIRECTORY).mkdir()
    append_line(tmp_path / DIRECTORY / OUTCOMES, line)
    (shown,) = Refreshes(tmp_path).summaries()["windows"]
    fresh = shown["sources"]["fresh"]
    assert holds(fresh["low"], P_OF_FRESH, fresh["high"])


def test_learnability_of_fresh_levels_and_of_a_buffer_is_without_bias(update) -> None:
    """Fresh levels of many p, some of which are always or never solved; solved episodes are 1 step long, others 8."""
    chance = np.random.default_rng(7)
    num_groups = NUM_WORLDS // PER_GROUP
    p = np.where(chance.random((num_groups, PER_GROUP)) < 0.3, chance.integers(0, 2, (num_groups, 1)), 0.4)
    p[:, 3] = p[:, 1]  # the last world of a group plays the level of the second
    copy_of = np.tile(np.array([-1, -1, -1, 1], np.int32), num_groups)
    outcome = outcome_of(course(chance, p.reshape(-1), MAX_STEPS))
    counts = jax.device_get(pairs_of(outcome, copy_of, np.ones(NUM_WORLDS, bool)))
    first = np.asarray(outcome.first_solved).reshape(num_groups, PER_GROUP)
    np.testing.assert_array_equal(counts, np.bincount(first[:, 1] + first[:, 3], minlength=3))
    _, sums, _ = update
    sums = sums | {BY_SOURCE: {**sums[BY_SOURCE], FRESH_PAIRS: counts}}
    metrics = training_metrics(sums, {}, frame_skip=1, sources=("fresh",))
    expected = (p[:, 1] * (1 - p[:, 1])).mean()
    differ = 2 * expected  # chance that the attempts of a pair differ; each such pair counts a half
    error = np.sqrt(differ * (1 - differ) / num_groups) / 2
    assert metrics["curriculum/fresh_learnability"] == pytest.approx(expected, abs=3 * error)
    assert expected < 0.2 and error < 0.01  # solve rates of all of them together would say 0.24
    now, error = (metrics[f"curriculum/learnability_now{end}"] for end in ("", "_error"))
    assert now == pytest.approx((P_OF_BUFFER * (1 - P_OF_BUFFER)).mean(), abs=0.01) and error > 0
    (line,) = OutcomeWindow(every=1).add(1, sums[BY_SOURCE], 0, ("fresh",))
    assert line["fresh_pairs"] == dict(zip(("none", "one", "both"), counts.tolist(), strict=True))


def test_a_world_that_is_there_once_more_is_in_no_pair(update) -> None:
    """The last group lies in another slot too, where it is not counted."""
    copy_of = np.tile(np.array([-1, 0, -1, -1], np.int32), NUM_WORLDS // PER_GROUP)
    is_counted = np.arange(NUM_WORLDS) < NUM_WORLDS - PER_GROUP
    assert int(pairs_of(update[0], copy_of, is_counted).sum()) == NUM_WORLDS // PER_GROUP - 1


def test_with_fewer_steps_than_an_episode_has_the_rate_is_that_of_solving_within_them() -> None:
    """4 steps are played. Solved after 2 of them or failed after 6: all that end are solved, and half of the worlds."""
    chance, p = np.random.default_rng(2), np.full(NUM_WORLDS, 0.5)
    outcome = outcome_of(course(chance, p, 4, solved_after=2, ended_after=6, fails=True))
    assert outcome.num_solved.sum() == outcome.num_finished.sum() > 0
    none = np.zeros(NUM_WORLDS, int)
    metrics = training_metrics(sums_over(outcome, none, none), {}, frame_skip=1, sources=("fresh",))
    low, high = wilson_interval(round(NUM_WORLDS * metrics["train/solve_rate"]), NUM_WORLDS)
    assert holds(low, 0.5, high) and metrics["train/failed_rate"] == 0.0
    # The return of an episode that goes on is what it has so far: 4 steps of -0.1.
    unsolved = np.asarray(outcome.first_solved) == 0
    np.testing.assert_allclose(np.asarray(outcome.first_return)[unsolved], -0.4, atol=1e-6)


def test_what_fails_early_is_counted_once_too() -> None:
    """Failed after 2 of 8 steps or solved after 8: of all episodes a third is solved, of first ones half."""
    chance, p = np.random.default_rng(3), np.full(NUM_WORLDS, 0.5)
    outcome = outcome_of(course(chance, p, MAX_STEPS, solved_after=MAX_STEPS, ended_after=2, fails=True))
    assert outcome.num_solved.sum() / outcome.num_finished.sum() < 0.4
    none = np.zeros(NUM_WORLDS, int)
    metrics = training_metrics(sums_over(outcome, none, none), {}, frame_skip=1, sources=("fresh",))
    low, high = wilson_interval(round(NUM_WORLDS * metrics["train/solve_rate"]), NUM_WORLDS)
    assert holds(low, 0.5, high) and metrics["train/failed_rate"] == pytest.approx(1 - metrics["train/solve_rate"])
