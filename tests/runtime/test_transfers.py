"""Batches on their way from rollout actors to learners, and their costs. No process is started here."""

import dataclasses

import jax
import numpy as np
import pytest

from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.messages import Trajectory
from kinetix_dist.runtime.cores.rollout_core import Batch
from kinetix_dist.runtime.cores.split_core import Staging
from kinetix_dist.runtime.driver.work_buffer import UPDATES_IN_A_ROW, Stragglers, added, copy_metrics, straggler_metrics
from kinetix_dist.runtime.processes.local import LocalFuture
from kinetix_dist.telemetry.event_names import check_event
from kinetix_dist.telemetry.names import COPIES, check_metrics
from tests.runtime.split_program import split_config


def _batch(first, last, num_steps=3):
    """Batch of worlds `first` to `last`, each of whose numbers says which world it is."""
    world = np.arange(first, last, dtype=np.float32)
    step = world + 100 * np.arange(num_steps, dtype=np.float32)[:, None]
    fields = {field.name: step for field in dataclasses.fields(Trajectory)}
    return Batch({"static": np.stack([world, world], axis=1)}, Trajectory(**fields), world)


@pytest.mark.parametrize("num_parts", [1, 3, 4])
def test_parts_that_come_in_any_order_lie_on_the_devices_in_that_of_their_worlds(num_parts):
    config, mesh = split_config(num_rollout_actors=num_parts), data_mesh(jax.devices()[:1])
    staging = Staging(config, mesh, Division(config.num_blocks, 1))
    size, copied = config.rollout.worlds_per_group, []
    for part in reversed(range(num_parts)):
        groups = config.groups_of_part(part, num_parts)
        content = LocalFuture((_batch(groups.start * size, groups.stop * size), None))
        copied.append(staging.add(7, part, num_parts, content))
    batch, seen = staging.take(7)
    expected = _batch(0, config.rollout.num_envs)
    jax.tree.map(np.testing.assert_array_equal, batch, expected)
    assert seen is None
    total = sum(x.nbytes for x in jax.tree.leaves(expected))
    in_all = added(copied)
    assert in_all["store_get"][0] == in_all["host_to_device"][0] == total
    assert in_all.get("host_layout", (0,))[0] == (0 if num_parts == 1 else total)  # one part is all: nothing to order


def test_a_learner_fetches_only_parts_that_hold_its_worlds():
    """Second of two learners: parts 0 and 1 of four belong to the other."""
    config, mesh = split_config(num_rollout_actors=4), data_mesh(jax.devices()[:1])
    staging = Staging(config, mesh, Division(config.num_blocks, 1))
    half = config.rollout.num_envs // 2
    staging._own_rows = lambda config: np.arange(half, 2 * half)
    size, copied = config.rollout.worlds_per_group, []
    for part in range(4):
        copied.append(staging.add(0, part, 4, LocalFuture((_batch(part * size, (part + 1) * size), None))))
    assert [("store_get" in found) for found in copied] == [False, False, True, True]
    batch, _ = staging.take(0)
    np.testing.assert_array_equal(batch.last_value, np.arange(half, 2 * half))


def test_copies_are_added_over_processes_and_the_slowest_counts():
    mib = 1 << 20
    metrics = copy_metrics([{"store_get": (mib, 0.5), "host_to_device": (mib, 0.1)}, {"store_get": (3 * mib, 0.25)}])
    assert metrics == {
        "copies/store_get_mib": 4.0,
        "copies/store_get_seconds": 0.5,
        "copies/host_to_device_mib": 1.0,
        "copies/host_to_device_seconds": 0.1,
    }
    check_metrics({f"copies/{name}_{unit}": 0.0 for name in COPIES for unit in ("mib", "seconds")})


def test_the_slowest_actor_is_named_with_what_it_lags_behind_the_others():
    headers = [{"seconds": seconds} for seconds in (1.0, 5.0, 1.5)]
    assert straggler_metrics(headers) == {"runtime/slowest_actor": 1.0, "runtime/slowest_actor_lag_seconds": 3.75}
    assert straggler_metrics(headers[:1]) == {}


def _noted_events(batches, *, steps=(64, 64, 64), replaced_before=None):
    """(process, update) of events. batches: seconds of each actor, of one batch after another."""
    noted = []
    stragglers = Stragglers(lambda kind, **details: noted.append((check_event(kind), details)))
    for update, seconds in enumerate(batches, start=1):
        if update == replaced_before:
            stragglers.reset(1)
        stragglers.add(update, [{"seconds": s, "num_env_steps": n} for s, n in zip(seconds, steps, strict=True)])
    assert all(kind == "straggler" for kind, _ in noted)
    return [(details["process"], details["update"]) for _, details in noted]


EVEN, SLOW = (1.0, 1.0, 1.2), (1.0, 2.5, 1.2)  # s of three actors; the median of the others is 1.1 s


def test_an_actor_that_is_slow_in_batch_after_batch_is_reported_once():
    in_a_row = UPDATES_IN_A_ROW
    assert _noted_events([SLOW] * (in_a_row - 1) + [EVEN] + [SLOW] * (in_a_row - 1)) == []  # busy moments
    assert _noted_events([EVEN] + [SLOW] * 3 * in_a_row) == [("rollout 1", in_a_row + 1)]
    # It is well in some batches only: known already. Then in as many as it took, and slow again: news.
    assert len(_noted_events(([SLOW] * in_a_row + [EVEN]) * 3)) == 1
    assert len(_noted_events([SLOW] * in_a_row + [EVEN] * in_a_row + [SLOW] * in_a_row)) == 2
    assert len(_noted_events([SLOW] * 2 * in_a_row, replaced_before=in_a_row + 1)) == 2  # as slow where it is now
    assert _noted_events([SLOW] * (2 * in_a_row - 2), replaced_before=in_a_row) == []


def test_every_straggler_is_named_and_who_has_more_to_do_is_none():
    batches = [(1.0, 1.0, 1.1, 5.0, 3.0)] * UPDATES_IN_A_ROW
    named = [("rollout 3", UPDATES_IN_A_ROW), ("rollout 4", UPDATES_IN_A_ROW)]
    assert _noted_events(batches, steps=(64,) * 5) == named
    assert _noted_events([SLOW] * UPDATES_IN_A_ROW, steps=(64, 128, 64)) == []
    assert _noted_events([(1.0, 0.9, 1.0)] * UPDATES_IN_A_ROW, steps=(64, 16, 64)) == []  # less to do, in as much time
    assert _noted_events([(1.0,)] * 9, steps=(64,)) == []  # there are no others
