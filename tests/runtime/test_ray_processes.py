"""Ray processes by themselves: who shares a GPU, and what a failure in one says. GPUs are slots of Ray's books here."""

import dataclasses

import pytest
import ray

from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.processes.failures import ProcessFailedError
from kinetix_dist.runtime.processes.placement import PlacementError, ProcessPlan, count_gpus, plan
from kinetix_dist.runtime.processes.ray_backend import RayBackend
from tests.runtime.cores_for_tests import build_from_missing_levels, build_greedy, build_told

ON_CPU = {"JAX_PLATFORMS": "cpu"}


@pytest.fixture(scope="module")
def backend():
    ray.init(address="local", num_cpus=16, num_gpus=3, include_dashboard=False, log_to_driver=False)
    backend = RayBackend(heartbeat_seconds=120.0)  # finds Ray running and takes part
    yield backend
    backend.stop()
    ray.shutdown()


def _plan_of_slots():
    """Three workers and a curator; their memory is not shared out, since there is no GPU to ask."""
    config = recipe("sfl_s")
    config = dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, num_envs=96, num_groups=3))
    placement = plan(config, num_gpus=3)
    processes = tuple(dataclasses.replace(p, memory=None, env_vars=ON_CPU) for p in placement.processes)
    return dataclasses.replace(placement, processes=processes)


def _devices(handles, backend):
    return backend.gather([handle.call("devices") for handle in handles])


def test_the_curator_shares_the_gpu_of_worker_0_and_of_no_other_also_after_a_restart(backend):
    placement = _plan_of_slots()
    backend.reserve(placement)
    workers = [backend.spawn([process], build_told)[0] for process in placement.of("worker")]
    curator = backend.spawn(placement.of("curator"), build_told)[0]
    first = _devices(workers, backend)
    assert sorted(first) == ["0", "1", "2"]
    assert _devices([curator], backend) == first[:1]
    backend.kill(workers)
    again = [backend.spawn([process], build_told)[0] for process in reversed(placement.of("worker"))][::-1]
    assert _devices(again, backend) == first
    backend.kill([*again, curator])


def test_gpus_that_another_run_holds_are_refused_in_words(backend, monkeypatch):
    monkeypatch.setattr("kinetix_dist.runtime.processes.ray_backend.GPUS_TIMEOUT_S", 1)
    with pytest.raises(PlacementError, match="needs 3 of the cluster's 3 GPUs, and they were not free"):
        backend.reserve(_plan_of_slots())


def test_a_process_that_runs_out_of_memory_says_which_and_what_to_do(backend):
    handle = backend.spawn([ProcessPlan(role="curator", index=0, env_vars=ON_CPU)], build_greedy)[0]
    with pytest.raises(ProcessFailedError) as caught:
        backend.gather([handle.call("call")])
    line = str(caught.value)
    assert line.startswith("curator 0 ran out of memory on ") and "RESOURCE_EXHAUSTED" in line
    assert "raise run.curator_memory_gib or lower curriculum.scoring_batch" in line
    assert "in call" in caught.value.details  # the traceback
    backend.kill([handle])


def test_a_build_that_fails_is_said_in_one_line_with_its_traceback_apart(backend):
    plans = [ProcessPlan(role="worker", index=0, env_vars=ON_CPU)]
    with pytest.raises(ProcessFailedError, match=r"^worker 0 failed: unknown level set 'nowhere'") as caught:
        backend.spawn(plans, build_from_missing_levels, "nowhere")
    assert "\n" not in str(caught.value)
    assert "build_from_missing_levels" in caught.value.details


def test_a_process_planned_for_a_gpu_that_is_not_there_says_so(backend):
    if count_gpus():
        pytest.skip("there is a GPU here")
    (process, _) = plan(recipe("sfl_s"), num_gpus=1).processes
    with pytest.raises(ProcessFailedError, match=r"^worker 0 failed: the NVIDIA driver"):
        backend.spawn([dataclasses.replace(process, gpu=None, gpu_share=0.0)], build_told)
