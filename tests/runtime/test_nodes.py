"""Nodes of a real Ray cluster (raylets on this machine) are lost and come back: runs shrink, wait and grow."""

import signal
import threading
import time
from collections.abc import Sequence
from typing import Any

import pytest
import ray
from ray.cluster_utils import Cluster

from kinetix_dist.runtime.driver.resizing import Resizing
from kinetix_dist.runtime.driver.stopping import EXIT_STOPPED, StopSignals
from kinetix_dist.runtime.processes.placement import Placement, PlacementError, ProcessPlan, plan_placement
from kinetix_dist.runtime.processes.ray_backend import RayBackend
from tests.helpers import PATIENCE_S
from tests.runtime.runs import tiny_config
from tests.runtime.train_process import LIMIT_S, TINY, events, rows, start, wait_for


@pytest.fixture(scope="module")
def head():
    """Head node with resources for two processes; it lives as long as the tests do."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False})
    yield cluster
    cluster.shutdown()


@pytest.fixture
def cluster(head):
    """The nodes that a test adds are gone after it."""
    yield head
    ray.shutdown()
    for node in list(head.worker_nodes):
        head.remove_node(node)


class _PlacedTrainer:
    """A trainer that only keeps its placement."""

    def place(self, placement: Placement) -> None:
        self.placement = placement

    def stop(self) -> None:
        pass


class _PlacedCurator:
    def place(self, plans: Sequence[ProcessPlan]) -> None:
        pass

    def stop(self) -> None:
        pass


@pytest.mark.long
def test_a_run_gets_fewer_places_after_its_node_is_lost_and_more_when_it_comes_back(cluster):
    """Two workers and a curator in three slots, one of them on a second node."""
    node = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    backend = RayBackend(heartbeat_seconds=60.0)
    notes: list[str] = []
    noted: list[tuple[str, dict[str, Any]]] = []
    config = tiny_config(num_updates=1, placement="colocated", num_workers=2, node_wait_seconds=0.5)
    placement, trainer, stop = plan_placement(config, num_gpus=0), _PlacedTrainer(), StopSignals()
    backend.reserve(placement)

    def note_event(kind: str, **details: Any) -> None:
        noted.append((kind, details))

    background = {"curator": _PlacedCurator()}
    resizing = Resizing(config, backend, placement, trainer, background, on_event=note_event, on_note=notes.append)
    resizing.fit(3, stop)
    assert not notes and not resizing.can_grow()  # nothing is lost

    cluster.remove_node(node)
    resizing.fit(4, stop)
    assert [process.name for process in trainer.placement.processes] == ["worker 0", "curator 0"]
    assert noted == [("resized", {"role": "worker", "before": 2, "now": 1, "update": 4})]
    assert "2 workers do not fit: " in notes[0] and ", 1 lost; waits 0.5 s" in notes[0]
    assert "goes on with 1 worker instead of 2" in notes[-1]
    assert not resizing.can_grow()
    began = time.monotonic()
    with pytest.raises(PlacementError, match=r"has 3 processes, and the cluster 2 CPU slots: .*\(2 CPU .*, 1 lost;"):
        backend.reserve(placement)
    assert time.monotonic() < began + 10.0
    backend.reserve(trainer.placement)

    node = cluster.add_node(num_cpus=1)
    _wait_until(resizing.can_grow)
    resizing.place(6, stop)
    assert resizing.size == 2 and noted[-1][1]["now"] == 2


def _wait_until(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _start(cluster, run, monkeypatch, *options):
    """A run of no end that computes, and saves every fifth update."""
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    ends = ["--run.total_env_steps", str(10**9), "--run.checkpoint_every", "5", "--run.node_wait_seconds", "1"]
    return start(run, *TINY, *ends, "--recording.num_rollouts", "0", *options)


def _ended(process):
    """Text on stderr of a run after a stop was requested."""
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == EXIT_STOPPED and "which is saved" in errors and "Traceback" not in errors, errors
    return errors


OPTIONS = {
    "colocated": ["--run.placement", "colocated", "--run.num_workers", "2"],
    "split": ["--run.placement", "split", "--run.num_rollout_actors", "2"],
}


@pytest.mark.slow  # starts processes eight times
@pytest.mark.parametrize("placement", OPTIONS)
def test_training_shrinks_when_a_node_is_lost_and_grows_when_it_comes_back(cluster, tmp_path, monkeypatch, placement):
    more = 1 if placement == "split" else 0  # the learner
    nodes = [cluster.add_node(num_cpus=1) for _ in range(1 + more)]
    run = tmp_path / "run"
    process = _start(cluster, run, monkeypatch, *OPTIONS[placement])
    try:
        wait_for(lambda: len(rows(run)) >= 7, process, "update 7")
        cluster.remove_node(nodes.pop())
        wait_for(lambda: bool(events(run, "resized", now=1)), process, "the smaller run")
        shrunk_at = events(run, "resized")[0]["update"]
        wait_for(lambda: rows(run)[-1]["update"] > shrunk_at + 3, process, "updates of the smaller run")
        cluster.add_node(num_cpus=1)
        wait_for(lambda: bool(events(run, "resized", now=2)), process, "the run of the old size")
        grown_at = events(run, "resized")[1]["update"]
        wait_for(lambda: rows(run)[-1]["update"] > grown_at + 3, process, "updates of the run of the old size")
        _ended(process)
    finally:
        process.kill()
    updates = [row["update"] for row in rows(run)]
    assert updates == list(range(1, len(updates) + 1))  # nothing is missing, and nothing twice
    resumed = [row["update"] for row in events(run, "resumed")]
    assert resumed[-1] == grown_at  # nothing was done again to grow
    lost, back = (" ".join(row["differs"]) for row in events(run, "resumed")[-2:])
    assert "processes" in lost and "processes" in back


@pytest.mark.slow
def test_training_waits_for_a_node_with_one_line_where_it_must_not_shrink(cluster, tmp_path, monkeypatch):
    node, run = cluster.add_node(num_cpus=1), tmp_path / "run"
    process = _start(cluster, run, monkeypatch, *OPTIONS["colocated"], "--run.min_workers", "2")
    said: list[str] = []
    errors = process.stderr
    assert errors is not None
    threading.Thread(target=lambda: said.extend(errors), daemon=True).start()
    try:
        wait_for(lambda: len(rows(run)) >= 7, process, "update 7")
        cluster.remove_node(node)
        wait_for(lambda: any("(run.min_workers) do not fit" in line for line in said), process, "the line")
        node = cluster.add_node(num_cpus=1)
        wait_for(lambda: bool(events(run, "recovered", role="worker")), process, "the recovery")
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=LIMIT_S)
    finally:
        process.kill()
    assert process.returncode == EXIT_STOPPED
    assert sum("do not fit" in line for line in said) == 2  # that it was lost, and that it is waited for
    assert all(row["differs"] == [] for row in events(run, "resumed"))


def test_a_split_run_gives_up_rollout_actors_before_learners():
    """Two learners and three actors: all sizes that are tried, the largest first. No node is needed."""
    config = tiny_config(num_updates=1, placement="split", num_learners=2, num_rollout_actors=3, min_workers=2)

    def ignore(*arguments: Any, **details: Any) -> None:
        pass

    nowhere: Any = None
    placement = plan_placement(config, num_gpus=0)
    resizing = Resizing(config, nowhere, placement, _PlacedTrainer(), {}, on_event=ignore, on_note=ignore)
    assert resizing.size == 5
    tried = resizing._smaller_and_smaller(resizing._least)
    assert [(c.run.num_learners, c.run.num_rollout_actors) for c in tried] == [(2, 3), (2, 2), (1, 3), (1, 2)]
