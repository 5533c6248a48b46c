"""Ray processes by themselves: sharing of GPUs, and lines of failures. GPUs are slots of Ray's books here."""

import dataclasses
import gc
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import ray
from ray._private.internal_api import memory_summary  # no public function says what the store holds

from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.processes.actor import _doing
from kinetix_dist.runtime.processes.backend import Sections
from kinetix_dist.runtime.processes.calls import Future, Group
from kinetix_dist.runtime.processes.failures import InputLostError, ProcessFailedError, WorkerLostError
from kinetix_dist.runtime.processes.placement import Placement, PlacementError, ProcessPlan, count_gpus, plan_placement
from kinetix_dist.runtime.processes.ray_backend import RayBackend
from kinetix_dist.runtime.processes.ray_calls import RayHandle
from kinetix_dist.telemetry.names import check_metrics
from tests.helpers import PATIENCE_S
from tests.runtime.cores_for_tests import (
    Compiler,
    Facts,
    Greedy,
    build_compiler,
    build_facts,
    build_from_missing_levels,
    build_greedy,
    build_together,
)
from tests.runtime.runs import without_evaluator

ON_CPU = {"JAX_PLATFORMS": "cpu"}


Restarted = tuple[list[RayHandle[Compiler]], list[list[int]]]


@pytest.fixture(scope="module")
def backend() -> Iterator[RayBackend]:
    ray.init(address="local", num_cpus=16, num_gpus=3, include_dashboard=False, log_to_driver=False)
    backend = RayBackend(heartbeat_seconds=120.0)  # finds Ray running and takes part
    yield backend
    backend.stop()
    ray.shutdown()


def _plan_of_slots(num_gpus: int = 3) -> Placement:
    """A worker a GPU and a curator; their memory is not shared out, since there is no GPU."""
    placement = plan_placement(without_evaluator(recipe("sfl_s")), num_gpus=num_gpus)
    processes = tuple(dataclasses.replace(p, memory=None, env_vars=ON_CPU) for p in placement.processes)
    return dataclasses.replace(placement, processes=processes)


def _devices(handles: Sequence[RayHandle[Facts]], backend: RayBackend) -> list[str | None]:
    return backend.gather([handle.call(Facts.devices) for handle in handles])


def _signal(handle: RayHandle[Any], number: signal.Signals) -> None:
    assert handle.pid is not None
    os.kill(handle.pid, number)


@pytest.mark.long
def test_the_curator_shares_the_gpu_of_worker_0_and_of_no_other_also_after_a_restart(backend: RayBackend) -> None:
    placement = _plan_of_slots(num_gpus=2)  # of three
    backend.reserve(placement)
    workers = [backend.spawn([process], build_facts)[0] for process in placement.of("worker")]
    curator = backend.spawn(placement.of("curator"), build_facts)[0]
    first = _devices(workers, backend)
    assert len(set(first)) == 2 and set(first) < {"0", "1", "2"}
    assert _devices([curator], backend) == first[:1]
    backend.kill(workers)
    again = [backend.spawn([process], build_facts)[0] for process in reversed(placement.of("worker"))][::-1]
    assert _devices(again, backend) == first
    backend.kill([*again, curator])


def test_gpus_that_another_run_holds_are_refused_in_words(backend: RayBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kinetix_dist.runtime.processes.ray_backend.FREE_TIMEOUT_S", 1.0)
    backend.release()
    taken = ray.util.placement_group([{"GPU": 1}])
    assert taken.wait(10)
    with pytest.raises(
        PlacementError, match=r"needs 3 of the cluster's 3 GPUs, .* not free within 1 s: .*3 GPUs\); wait"
    ):
        backend.reserve(_plan_of_slots())
    ray.util.remove_placement_group(taken)


def test_cpu_slots_that_are_not_there_or_taken_are_refused_in_words(
    backend: RayBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kinetix_dist.runtime.processes.ray_backend.FREE_TIMEOUT_S", 0.5)

    def workers(number: int) -> Placement:
        return Placement(processes=tuple(ProcessPlan(role="worker", index=index) for index in range(number)))

    with pytest.raises(PlacementError, match=r"has 17 processes, and the cluster 16 CPU slots: .*3 GPUs\); start Ray"):
        backend.reserve(workers(17))
    taken = ray.util.placement_group([{"CPU": 10}])
    assert taken.wait(10)
    with pytest.raises(PlacementError, match=r"needs 10 of the cluster's 16 CPU slots, and \d were free within 0.5 s"):
        backend.reserve(workers(10))
    ray.util.remove_placement_group(taken)


def test_a_process_that_runs_out_of_memory_says_which_and_what_to_do(backend: RayBackend) -> None:
    handle = backend.spawn([ProcessPlan(role="curator", index=0, env_vars=ON_CPU)], build_greedy)[0]
    with pytest.raises(ProcessFailedError) as caught:
        backend.gather([handle.call(Greedy.call)])
    line = str(caught.value)
    assert line.startswith("curator 0 ran out of memory on ") and "RESOURCE_EXHAUSTED" in line
    assert "raise run.curator_memory_gib or lower curriculum.scoring_batch" in line
    assert "in call" in caught.value.details  # the traceback
    backend.kill([handle])


def test_a_build_that_fails_is_said_in_one_line_with_its_traceback_apart(backend: RayBackend) -> None:
    plans = [ProcessPlan(role="worker", index=0, env_vars=ON_CPU)]
    with pytest.raises(ProcessFailedError, match=r"^worker 0 failed: unknown level set 'nowhere'") as caught:
        backend.spawn(plans, build_from_missing_levels, "nowhere")
    assert "\n" not in str(caught.value)
    assert "build_from_missing_levels" in caught.value.details


def test_a_process_planned_for_a_gpu_that_is_not_there_says_so(backend: RayBackend) -> None:
    if count_gpus():
        pytest.skip("there is a GPU here")
    (process, _) = plan_placement(without_evaluator(recipe("sfl_s")), num_gpus=1).processes
    with pytest.raises(ProcessFailedError, match=r"^worker 0 failed: the NVIDIA driver"):
        backend.spawn([dataclasses.replace(process, gpu=None, gpu_share=0.0)], build_facts)


@pytest.mark.long
def test_learners_and_actors_are_started_at_the_same_time(backend: RayBackend, tmp_path: Path) -> None:
    groups = [
        Group([ProcessPlan(role=role, index=0, env_vars=ON_CPU)], build_together, str(tmp_path), 2)
        for role in ("learner", "rollout")
    ]
    (learner,), (actor,) = backend.spawn_both(*groups)
    assert len({learner.pid, actor.pid}) == 2
    backend.kill([learner, actor])


# A group of two


@pytest.mark.long
def test_a_port_that_is_taken_after_it_was_found_free_is_a_loss_and_not_the_end(
    backend: RayBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program takes it between the two: the group is lost, and started again with another port."""
    plans = [ProcessPlan(role="worker", index=index, env_vars=ON_CPU) for index in range(2)]
    query = backend._all
    taken: list[socket.socket] = []

    def ask_and_take(actors: Sequence[Any], references: Sequence[Any]) -> list[Any]:
        answers = query(actors, references)
        if isinstance(answers[0], str) and answers[0].count(":") == 1:
            host, _, port = answers[0].partition(":")
            taken.append(socket.create_server((host, int(port))))
        return answers

    monkeypatch.setattr(backend, "_all", ask_and_take)
    with pytest.raises(WorkerLostError, match=r"worker 0 (found the port of its group taken|died)"):
        backend.spawn(plans, build_facts)
    assert len(taken) == 1
    taken[0].close()


@pytest.fixture(scope="module")
def restarted(backend: RayBackend, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Restarted]:
    """(two workers of one JAX world, started for the second time; programs that they found compiled, both times)."""
    plans = [ProcessPlan(role="worker", index=index, env_vars=ON_CPU) for index in range(2)]
    directory = str(tmp_path_factory.mktemp("compiled"))
    hits: list[list[int]] = []
    handles: list[RayHandle[Compiler]] = []
    for _ in range(2):
        backend.kill(handles)
        handles = backend.spawn(plans, build_compiler, directory)
        hits.append(backend.gather([handle.call(Compiler.num_hits) for handle in handles]))
    yield handles, hits
    backend.kill(handles)


@pytest.mark.long
def test_after_a_restart_no_rank_of_a_group_compiles_again(restarted: Restarted) -> None:
    assert restarted[1] == [[0, 0], [1, 1]]


def test_processes_say_how_idle_they_are_and_what_they_hold_and_moved(
    backend: RayBackend, restarted: Restarted
) -> None:
    busy, idle = restarted[0]
    backend.gather([busy.call(Compiler.sleep, 0.0), idle.call(Compiler.sleep, seconds=0.0)])
    call = busy.call(Compiler.sleep, 3.0, np.zeros(1 << 20, np.uint8))
    found: dict[str, float] = {}
    deadline = time.monotonic() + PATIENCE_S
    before = found
    while not ("runtime/idle_worker" in found and before.get("runtime/idle_worker") != found["runtime/idle_worker"]):
        assert time.monotonic() < deadline, found
        time.sleep(0.5)
        before, found = found, backend.measures()  # does not wait for the call that runs
    check_metrics(found)
    assert 0.0 <= found["runtime/idle_worker"] <= 1.0
    assert 0.05 < found["memory/resident_gib_worker"] < 8 and found["memory/resident_gib_driver"] > 0.05
    assert 0.0 < found["memory/host_share"] <= 1.0 and found["runtime/compile_seconds"] > 0
    backend.gather([call])
    while found["runtime/moved_mib_worker"] < 1.0:  # counted when the call has answered
        assert time.monotonic() < deadline, found
        time.sleep(0.1)
        found = backend.measures()
    assert ("memory/gpu_share" in found) == (count_gpus() > 0 and "cpu" not in ON_CPU.values())


def test_what_is_needed_next_is_fetched_while_a_call_computes_and_storing_it_is_timed(
    backend: RayBackend, restarted: Restarted
) -> None:
    (learner, actor), _ = restarted
    computing = learner.call(Compiler.compute_until_handed, 60.0)
    header, content = actor.call_with_header(Compiler.give, 1 << 20)
    (found,) = backend.gather([header])
    assert found["size"] == found["put"][0] == 1 << 20 and found["put"][1] > 0
    handed = learner.call_in_background(Compiler.hand, content=content)
    first = backend.first_ready([computing, handed])
    assert first and all(future is computing or future is handed for future in first)
    assert backend.gather([computing, handed]) == [1 << 20, None]
    with pytest.raises(ProcessFailedError, match="worker 1 failed"):
        backend.gather([actor.call_with_header(Compiler.give, -1)[0]])


def _stored_mib() -> int:
    """Return the MiB in the object store of this machine."""
    summary = memory_summary(ray.get_runtime_context().gcs_address, stats_only=True)
    used = re.search(r"Plasma memory usage (\d+) MiB", summary)
    assert used is not None, summary
    return int(used[1])


def _wait_for(condition: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        gc.collect()  # errors hold what they were raised over, in cycles
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.long
def test_answers_that_are_never_fetched_or_whose_process_dies_while_it_stores_them_leave_nothing(
    backend: RayBackend, tmp_path: Path
) -> None:
    (process,) = backend.spawn([ProcessPlan(role="rollout", index=0, env_vars=ON_CPU)], build_compiler, str(tmp_path))
    before = _stored_mib()
    header, content = process.call_with_header(Compiler.give_what_cannot_be_stored)
    for future in (header, content):
        with pytest.raises(ProcessFailedError, match="rollout 0 failed: TypeError: cannot pickle"):
            backend.gather([future])
    assert ray.get(process.actor.doing.remote()).what == "idle"  # the call is over for the process, too
    header, content = process.call_with_header(Compiler.give, 32 << 20)
    backend.gather([header])
    assert _stored_mib() == before + 32
    del content
    _wait_for(lambda: _stored_mib() == before)
    header, content = process.call_with_header(Compiler.give_and_hang, 32 << 20, str(tmp_path / "stored"))
    _wait_for((tmp_path / "stored").exists)
    assert _stored_mib() == before + 32 and not content.is_ready()
    _signal(process, signal.SIGKILL)
    for future in (header, content):
        with pytest.raises(WorkerLostError, match="rollout 0 died"):
            backend.gather([future])
    del header, content, future
    _wait_for(lambda: _stored_mib() == before)
    backend.kill([process])


def test_a_call_that_never_returns_and_a_stopped_process_are_named_within_the_limit_and_5_s(
    backend: RayBackend, restarted: Restarted
) -> None:
    (stopped, asleep), _ = restarted
    backend.sections.limits = {"save": 2.0}

    def lost(*tickets: Future[None]) -> tuple[str, str, str]:
        began = time.monotonic()
        with pytest.raises(WorkerLostError) as caught, backend.sections.section("save"):
            backend.gather(tickets)
        assert 2.0 < time.monotonic() - began < 2.0 + 5.0
        return caught.value.process, caught.value.section, str(caught.value)

    name, section, text = lost(stopped.call(Compiler.sleep, 0.0), asleep.call(Compiler.sleep, 1000.0))
    assert (name, section) == ("worker 1", "save")
    assert re.search(r"not done within the 2 s of run.limits.save: worker 1 in sleep for 2 s, at cores_for", text)
    _signal(stopped, signal.SIGSTOP)
    name, section, text = lost(stopped.call(Compiler.sleep, 0.0))
    assert (name, section) == ("worker 0", "save")
    assert text == "not done within the 2 s of run.limits.save: worker 0 does not answer"
    _signal(stopped, signal.SIGCONT)
    backend.sections.limits = {}


@pytest.mark.long
def test_settings_of_the_network_reach_processes_and_others_do_not(
    backend: RayBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NCCL_SOCKET_IFNAME", "eth7")
    monkeypatch.setenv("SOMETHING_ELSE", "here")
    handle = backend.spawn([ProcessPlan(role="curator", index=0, env_vars=ON_CPU)], build_facts)[0]
    calls = [handle.call(Facts.environment, name) for name in ("NCCL_SOCKET_IFNAME", "SOMETHING_ELSE")]
    assert backend.gather(calls) == ["eth7", None]
    backend.kill([handle])


def test_a_call_that_lacks_its_argument_is_the_loss_of_who_was_to_make_it(
    backend: RayBackend, restarted: Restarted
) -> None:
    (well, lost), _ = restarted
    lost.call(Compiler.sleep, 1000.0)
    made_of_it = well.call(Compiler.sleep, seconds=lost.call(Compiler.num_hits).as_argument())
    _signal(lost, signal.SIGKILL)
    with pytest.raises(InputLostError, match="worker 1 died before worker 0 had its answer") as caught:
        backend.gather([made_of_it])
    assert caught.value.process == "worker 1"
    assert backend.gather([well.call(Compiler.sleep, 0.0)]) == [None]


def test_the_first_pass_of_a_section_may_take_the_time_to_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    """The section may take as long as a process compiles: a hanging call is noticed after the limit of the section."""
    sections, now = Sections(), [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    sections.limits = {"update": 10.0, "save": 5.0, "compile": 100.0}
    for _ in range(2):
        with sections.section("update"):  # the first pass
            for _ in range(10):
                now[0] += 10.5
                assert sections.is_overdue and sections.extend() and not sections.is_overdue
            now[0] += 10.5
            assert sections.is_overdue and not sections.extend()  # 110 s in all
        for name, limit in (("update", 10.0), ("save", 5.0)):
            with sections.section(name):
                now[0] += limit
                assert not sections.is_overdue
                now[0] += 0.5
                assert sections.is_overdue and not sections.extend()
        sections.reset()


def test_a_process_says_that_it_compiles_and_nothing_else_is_taken_for_that() -> None:
    def of_thread(work: Callable[[], object]) -> float:
        thread = threading.Thread(target=work)
        thread.start()
        assert thread.ident is not None
        said: list[bool] = []
        while thread.is_alive():
            said.append(_doing(thread.ident, "work", time.monotonic()).is_compiling)
            time.sleep(0.01)
        return sum(said) / len(said)

    def traced(x: Any) -> Any:
        time.sleep(0.5)
        return x + 1

    assert of_thread(lambda: jax.jit(traced).lower(1.0)) > 0.5
    assert of_thread(lambda: traced(1.0)) == 0.0


@pytest.mark.long
def test_an_idle_process_that_dies_is_noticed_where_others_are_waited_for(backend: RayBackend, tmp_path: Path) -> None:
    plans = [ProcessPlan(role="rollout", index=index, env_vars=ON_CPU) for index in range(2)]
    idle, well = backend.spawn(plans, build_compiler, str(tmp_path))
    backend.check([idle])
    working = well.call(Compiler.sleep, 1000.0)
    _signal(idle, signal.SIGKILL)
    began = time.monotonic()
    with pytest.raises(WorkerLostError, match="rollout 0 died") as caught:
        backend.first_ready([working], watched=[idle])
    assert caught.value.process == "rollout 0" and time.monotonic() - began < 15.0
    with pytest.raises(WorkerLostError, match="rollout 0 died"):
        backend.check([idle])
    backend.kill([idle, well])
