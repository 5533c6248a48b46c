"""Faults in the physics of a rollout are counted, reported and warned of once. Real engines, bad levels."""

import dataclasses
import json
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest

from jax2d import Effects, Engine
from kinetix_dist.env.environment import Environment
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curator_core import CuratorCore
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.rollout_core import Players, RolloutCore
from kinetix_dist.runtime.cores.worker import Worker
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.roles import Refresh
from kinetix_dist.runtime.driver.totals import WARNINGS
from kinetix_dist.runtime.processes.local import LocalBackend, LocalFuture
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.telemetry.names import METRICS
from tests.runtime.runs import NotingReporter, run_updates, tiny_config

NUM_WORLDS, NUM_STEPS, FRAME_SKIP = 16, 8, 2  # of the recipe `tiny`; half of the worlds play levels of the buffer
PHYSICS_STEPS = NUM_WORLDS * NUM_STEPS * FRAME_SKIP


def _with_nan(scored):
    """The same levels, but none of their shapes is anywhere."""
    levels = dataclasses.replace(scored.levels, position=np.full_like(scored.levels.position, np.nan))
    return dataclasses.replace(scored, levels=levels)


@pytest.fixture(scope="module")
def worker() -> Worker:
    worker = Worker(tiny_config(num_updates=1), data_mesh())
    worker.start(None)
    return worker


@pytest.fixture(scope="module")
def scored(worker: Worker) -> Any:
    """A refresh by the policy of the worker."""
    seconds, scored = CuratorCore(tiny_config(num_updates=1)).refresh(worker.weights(), 0, 0, 1)
    assert seconds["seconds"] > 0
    return scored


def test_a_healthy_rollout_counts_nothing_that_should_be_zero(worker: Worker, scored: Any) -> None:
    worker.adopt(scored)
    metrics, *_ = worker.run_update(0)
    assert {name for name in METRICS if name.startswith("physics/")} <= metrics.keys()
    assert all(metrics[f"physics/{kind}"] == 0 for kind in WARNINGS)


def test_worlds_that_are_not_finite_are_reset_in_every_step_and_counted(worker: Worker, scored: Any) -> None:
    worker.adopt(_with_nan(scored))
    metrics, *_ = worker.run_update(0)
    times = NUM_WORLDS // 2 * NUM_STEPS
    assert metrics["physics/unstable_worlds"] == times
    assert metrics["physics/unstable"] == pytest.approx(1e6 * times / PHYSICS_STEPS)
    assert metrics["train/episodes"] >= times  # each ended an episode


def _sums(effects, weights):
    """Sums of a rollout with an engine that has these effects alone, on levels with all effects."""
    config = tiny_config(num_updates=1)
    levels = dataclasses.replace(config.curriculum, name="fixed", levels="designed_s")
    config = dataclasses.replace(config, curriculum=levels)
    env = Environment(config.env, engine=Engine(config.env.capacity, effects=effects))
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    curriculum = make_curriculum(config, env, policy, data_mesh())
    players = Players(env, policy, curriculum)
    core = RolloutCore(config, players, data_mesh(), groups=range(config.rollout.num_groups))
    return jax.device_get(core.play(weights, curriculum.init(), 0).sums)["physics"]


@pytest.mark.long
def test_effects_that_an_engine_lacks_and_contacts_without_a_slot_are_counted(worker):
    weights = worker.weights()  # the policy is the same, whatever levels are played
    full = Effects.full(tiny_config(num_updates=1).env.capacity)
    assert _sums(full, weights).missing_effects == 0
    assert _sums(full.without("gravity"), weights).missing_effects == NUM_WORLDS * NUM_STEPS  # all of them have gravity
    crowded = _sums(dataclasses.replace(full, contact_slots=1), weights)
    assert crowded.contact_overflow > 0
    assert crowded.missing_effects > 0


class _PoisonedCurator(CuratorClient):
    """A curator whose levels are nowhere from the second refresh on."""

    def take(self, *, patience_s: float | None, meanwhile: Callable[[], None] = lambda: None) -> Refresh | None:
        refresh = super().take(patience_s=patience_s, meanwhile=meanwhile)
        assert refresh is not None
        if self.num_taken:
            parts = [LocalFuture(_with_nan(part.fetch())) for part in refresh.parts]
            refresh = dataclasses.replace(refresh, parts=parts)
        self.num_taken += 1
        return refresh

    num_taken = 0


def test_a_run_warns_once_of_each_kind_and_says_how_often_at_its_end(tmp_path):
    config = tiny_config(num_updates=8)  # the second buffer is adopted at update 5
    reporter = NotingReporter()
    backend = LocalBackend()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    curator = _PoisonedCurator(config, backend, [ProcessPlan(role="curator", index=0)])
    controller = run_updates(config, tmp_path / "run", trainer, curator, reporter=reporter)
    (skipped, note) = reporter.notes
    assert skipped == "update 6 was skipped: no gradient was finite"  # half of the levels are nan themselves
    times = NUM_WORLDS // 2 * NUM_STEPS
    assert note.startswith(f"physics: {times} worlds were not finite and were reset in {PHYSICS_STEPS} physics steps; ")
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [(e["counter"], e["count"], e["update"]) for e in events if e["event"] == "physics_warning"] == [
        ("unstable", times, 6)
    ]
    assert [row["physics/unstable_worlds"] for row in reporter.rows] == [0] * 5 + [times] * 3
    assert controller.physics["physics_steps"] == 8 * PHYSICS_STEPS
    assert controller.physics["unstable"] == 3 * times
    assert all(row["curriculum/scoring_seconds"] > 0 for row in reporter.rows)


def test_every_warning_belongs_to_a_metric():
    assert {f"physics/{kind}" for kind in WARNINGS} <= METRICS.keys()
