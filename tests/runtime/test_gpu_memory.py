"""Budgets of a GPU's memory. The figures are those of one H200; no test here needs a GPU."""

import dataclasses
import os
import subprocess
import sys

import pytest
import warp as wp

from jax2d import Effects, preset
from jax2d.warp.memory import thread_bytes as compiled_thread_bytes
from kinetix_dist.level.level import SIZES
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.processes.failures import failure_of
from kinetix_dist.runtime.processes.gpu_memory import (
    GIB,
    MIB,
    Gpu,
    GpuMemoryError,
    budget_of,
    local_memory_bytes,
    this_gpu,
    thread_bytes,
)
from kinetix_dist.runtime.processes.placement import plan_placement
from tests.helpers import PATIENCE_S, python_path
from tests.runtime.runs import without_evaluator

# 143,771 MiB, of which the driver keeps 615.
H200 = Gpu(name="NVIDIA H200", total_bytes=143_156 * MIB, num_sms=132, threads_per_sm=2048)
# Compiled for sm_90 with jax2d.warp.memory.thread_bytes.
COMPILED_THREAD_BYTES = {"s": 4512, "m": 6736, "l": 13056}
# MiB that CUDA took of an H200 for kernels of these bytes a thread: S, M and L of an earlier engine.
MEASURED_LOCAL_MIB = {4304: 846, 6304: 1360, 11472: 2694}
MEASURED_CONTEXT, MEASURED_PROGRAMS = 560 * MIB, 250 * MIB


def _budgets(config, num_gpus=1, gpu=H200):
    placement = plan_placement(config, num_gpus=num_gpus)
    budgets = {}
    for process in placement.processes:
        assert process.memory is not None
        budgets[process.name] = budget_of(process.name, process.memory, gpu)
    return budgets


def _with_run(config, **fields):
    return dataclasses.replace(config, run=dataclasses.replace(config.run, **fields))


@pytest.mark.parametrize("size", SIZES)
def test_the_estimate_of_a_threads_local_memory_is_above_that_of_the_kernel_but_not_far(size):
    assert 1.0 < thread_bytes(SIZES[size]) / COMPILED_THREAD_BYTES[size] < 1.25


@pytest.mark.parametrize("size", SIZES)
def test_what_was_recorded_of_a_kernel_is_what_it_compiles_to(monkeypatch, size):
    monkeypatch.setattr(wp.config, "optimization_level", None)  # as for users: tests have another one for a CPU
    capacity = SIZES[size]
    compiled = compiled_thread_bytes(capacity, preset("standard"), Effects.full(capacity), "9.0")
    assert compiled <= thread_bytes(capacity)
    assert compiled == pytest.approx(COMPILED_THREAD_BYTES[size], rel=0.05)  # beyond that: fit NUMBERS_OF again


@pytest.mark.parametrize(("compiled", "measured_mib"), MEASURED_LOCAL_MIB.items())
def test_local_memory_is_what_was_measured(compiled, measured_mib):
    assert local_memory_bytes(compiled, H200) / MIB == pytest.approx(measured_mib, abs=2)  # CUDA takes pages of 2 MiB


@pytest.mark.parametrize("size", SIZES)
def test_worker_and_curator_fit_on_one_gpu_with_all_that_they_were_seen_to_take(size):
    budgets = _budgets(recipe(f"sfl_{size}"))
    taken = 0
    for budget in budgets.values():
        next_to_pool = MEASURED_CONTEXT + MEASURED_PROGRAMS + local_memory_bytes(COMPILED_THREAD_BYTES[size], H200)
        assert next_to_pool < budget.reserve_bytes
        taken += float(budget.environment["XLA_CLIENT_MEM_FRACTION"]) * H200.total_bytes + next_to_pool
    assert taken < 0.98 * H200.total_bytes
    assert budgets["curator 0"].pool_bytes > 3 * 309 * MIB  # scoring 4,096 levels of M
    assert budgets["worker 0"].pool_bytes > 0.8 * H200.total_bytes


def test_a_curator_that_scores_more_gets_more():
    config = without_evaluator(recipe("sfl_m"))
    larger = dataclasses.replace(config.curriculum, num_candidates=65536, scoring_batch=65536)
    assert (
        _budgets(dataclasses.replace(config, curriculum=larger))["curator 0"].pool_bytes
        > 4 * _budgets(config)["curator 0"].pool_bytes
    )


def test_an_evaluator_needs_what_it_plays_whatever_is_scored_at_once():
    config = recipe("sfl_m")
    larger = dataclasses.replace(config.curriculum, num_candidates=65536, scoring_batch=65536)
    found = _budgets(dataclasses.replace(config, curriculum=larger))
    assert found["evaluator 0"] == _budgets(config)["evaluator 0"]
    assert found["curator 0"].pool_bytes > 4 * found["evaluator 0"].pool_bytes


def test_only_the_gpu_that_is_shared_pays_for_the_curator():
    budgets = _budgets(without_evaluator(recipe("sfl_m")), num_gpus=4)
    assert budgets["worker 1"].total_bytes == budgets["worker 3"].total_bytes == int(0.98 * H200.total_bytes)
    assert budgets["worker 0"].total_bytes + budgets["curator 0"].total_bytes == budgets["worker 1"].total_bytes
    alone = _budgets(without_evaluator(recipe("sfl_m")), num_gpus=1)["worker 0"]
    assert budgets["worker 0"].reserve_bytes - alone.reserve_bytes >= 1 * GIB  # NCCL


def test_a_worker_without_a_curator_has_its_gpu_to_itself():
    config = without_evaluator(recipe("sfl_m"))
    config = dataclasses.replace(config, curriculum=dataclasses.replace(config.curriculum, name="domain_randomization"))
    assert _budgets(config)["worker 0"].total_bytes == int(0.98 * H200.total_bytes)


def test_what_the_curator_and_the_run_get_can_be_set():
    config = _with_run(without_evaluator(recipe("sfl_m")), gpu_memory_gib=40.0, curator_memory_gib=8.0)
    budgets = _budgets(config)
    assert budgets["curator 0"].total_bytes == 8 * GIB
    assert budgets["worker 0"].total_bytes + 8 * GIB == int(0.98 * 40 * GIB)


def test_a_run_that_does_not_fit_is_refused_with_the_numbers():
    small = Gpu(name="small", total_bytes=8 * GIB, num_sms=132, threads_per_sm=2048)
    with pytest.raises(GpuMemoryError, match=r"do not fit into 7\.8 GiB of small \(curator 0 .* GiB.*; worker 0 "):
        _budgets(without_evaluator(recipe("sfl_l")), gpu=small)
    with pytest.raises(GpuMemoryError, match=r"change run\.curator_memory_gib"):
        _budgets(_with_run(without_evaluator(recipe("sfl_m")), curator_memory_gib=1.0))


def test_without_a_driver_a_gpu_is_refused_in_words():
    try:
        gpu = this_gpu()
    except GpuMemoryError as error:
        assert "NVIDIA driver" in str(error) and "\n" not in str(error)
    else:
        assert gpu.total_bytes > GIB and gpu.num_sms > 0 and gpu.threads_per_sm >= 1024


@pytest.mark.parametrize(
    ("process", "text", "said"),
    [
        (
            "curator 0",
            "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 12345 bytes.",
            "XLA's pool, which is full; raise run.curator_memory_gib or lower curriculum.scoring_batch",
        ),
        (
            "worker 0",
            "RESOURCE_EXHAUSTED: Out of memory",
            "which is full; lower rollout.num_envs",
        ),
        (
            "worker 0",
            "UNKNOWN: FFI callback error: RuntimeError: Error launching kernel: step_worlds on device cuda:0: "
            "Warp CUDA error 2: out of memory",
            "beyond XLA's pool: its budget is 132.9 GiB",
        ),
        (
            "learner 0",
            "INTERNAL: CUDA_ERROR_OUT_OF_MEMORY: out of memory",
            "set run.gpu_memory_gib below the 139.8 GiB",
        ),
    ],
)
def test_memory_that_ran_out_is_said_in_one_line_with_process_gpu_budget_and_remedy(process, text, said):
    config = without_evaluator(recipe("sfl_m"))
    if process == "learner 0":
        config = _with_run(config, placement="split")
    budget = _budgets(config, num_gpus=2 if process == "learner 0" else 1)[process]
    failure = failure_of(process, RuntimeError(text), budget)
    line = str(failure)
    assert line.startswith(f"{process} ran out of memory on GPU 0 of ") and "NVIDIA H200" in line and said in line
    assert "\n" not in line


def test_other_errors_keep_their_own_words():
    assert str(failure_of("worker 1", ValueError("unknown level set 'x'"), None)) == (
        "worker 1 failed: unknown level set 'x'"
    )
    assert str(failure_of("worker 1", KeyError("x"), None)) == "worker 1 failed: KeyError: 'x'"


def test_imports_do_not_start_jax_before_the_memory_budget_is_set():
    code = (
        "import kinetix_dist.runtime.processes.actor, kinetix_dist.runtime.cores.build\n"
        "from jax._src import xla_bridge\n"
        "assert not xla_bridge.backends_are_initialized(), 'a module computes while it is imported'"
    )
    environment = {**os.environ, "PYTHONPATH": python_path()}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
