"""A worker runs the programs that were compiled ahead; what fails in a thread is raised where it is waited for."""

from __future__ import annotations

import contextvars
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.warp import ffi
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.runtime.cores import programs
from kinetix_dist.runtime.cores.programs import THREAD, Ahead
from kinetix_dist.runtime.cores.worker import Worker
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.processes.actor import _doing
from kinetix_dist.runtime.processes.calls import Call
from kinetix_dist.runtime.processes.local import LocalBackend, LocalFuture, LocalHandle
from kinetix_dist.runtime.processes.placement import ProcessPlan
from tests.runtime.runs import tiny_config

LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"


@pytest.fixture
def lowered() -> Iterator[list[tuple[str, str]]]:
    """(function, thread) of every program that is lowered meanwhile."""
    found: list[tuple[str, str]] = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == LOWERED:
            found.append((str(kwargs["fun_name"]), threading.current_thread().name))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)


def test_a_run_of_updates_alone_compiles_no_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "has_cores", lambda: True)
    config, mesh = tiny_config(num_updates=8), data_mesh(jax.devices()[:1])
    for only_updates in (False, True):
        run = dataclasses.replace(config.run, only_updates=only_updates)
        worker = Worker(dataclasses.replace(config, run=run), mesh, ahead_of=0)
        worker.start(None)
        assert bool(worker._evaluation_programs._jobs) is not only_updates
        worker._evaluation_programs.wait()
        worker._update_programs.wait()


# Of rollout, update and scoring.
PROGRAMS = {"jit(rollout)", "jit(update)", "jit(_score)"}


@pytest.mark.parametrize(
    ("is_resumed", "reset_every"),
    [pytest.param(False, 1, marks=pytest.mark.long), (True, 1), pytest.param(True, 3, marks=pytest.mark.long)],
)
def test_neither_refresh_nor_update_compile_again_what_was_compiled_ahead(
    lowered, is_resumed, reset_every, monkeypatch
):
    monkeypatch.setattr(programs, "has_cores", lambda: True)
    config, mesh = tiny_config(num_updates=8, num_curators=0), data_mesh(jax.devices()[:1])
    config = dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, reset_every=reset_every))
    before = Worker(config, mesh)
    before.start(None)
    _, refreshed = before.refresh(before.released(), 0, 0, 1)
    before.adopt(refreshed)
    arrays, update = None, 0
    expected, *_ = before.run_update(0)
    if is_resumed:
        arrays, update = before.snapshot() | before.ongoing_worlds(), 1
        expected, *_ = before.run_update(1)

    jax.clear_caches()  # programs are cached for workers of equal settings
    lowered.clear()
    worker = Worker(config, mesh, update)
    worker.start(arrays)
    # At once: it waits for the threads, else it would compile them too.
    if is_resumed:  # tracing during an update slows its launch
        assert not worker._refresh_programs._jobs
    else:
        _, refreshed = worker.refresh(worker.released(), 0, 0, 1)
        worker.adopt(refreshed)
    metrics, *_ = worker.run_update(update)
    worker._refresh_programs.wait()
    names = [*PROGRAMS, "jit(rollout)"] if reset_every > 1 else PROGRAMS  # resets are a program of their own
    assert sorted(found for found in lowered if found[0] in PROGRAMS) == sorted((name, THREAD) for name in names)
    np.testing.assert_equal(metrics, expected)
    worker._evaluation_programs.wait()


@pytest.mark.long
def test_a_new_policy_is_evaluated_by_the_program_that_was_compiled_while_random_actions_played(lowered, monkeypatch):
    monkeypatch.setattr(programs, "has_cores", lambda: True)
    config, mesh = tiny_config(num_updates=8), data_mesh(jax.devices()[:1])
    before = Worker(config, mesh)
    before.start(None)
    expected = [before.evaluate(use_policy) for use_policy in (False, True)]

    jax.clear_caches()
    lowered.clear()
    worker = Worker(config, mesh, 0)
    worker.start(None)
    rates = [worker.evaluate(use_policy) for use_policy in (False, True)]
    assert rates == expected
    assert sorted(thread == THREAD for name, thread in lowered if name == "jit(play_attempts)") == [False, True]
    worker._update_programs.wait()


CALLS: dict[str, tuple[str, list[Any]]] = {
    "_refresh_programs": ("refresh", [None] * 4),
    "_update_programs": ("run_update", [0]),
    "_evaluation_programs": ("evaluate", [True]),
}


@pytest.mark.parametrize("programs", CALLS)
def test_an_error_of_a_compilation_is_raised_by_the_call_that_runs_the_program(programs):
    call, arguments = CALLS[programs]
    worker = Worker.__new__(Worker)  # nothing else of it is used before
    setattr(worker, programs, Ahead())

    def fail() -> None:
        raise ValueError("too large")

    getattr(worker, programs).begin(fail)
    with pytest.raises(ValueError, match="too large"):
        getattr(worker, call)(*arguments)


class _Handle(LocalHandle[Any]):
    """Handle of a process that only keeps its calls."""

    def __init__(self) -> None:
        super().__init__(ProcessPlan(role="worker", index=0), None)
        self.calls: list[tuple[Any, ...]] = []

    def _call(self, call: Call) -> LocalFuture[None]:
        self.calls.append((call.method, *call.arguments))
        return LocalFuture(None)


class _Backend(LocalBackend):
    """Starts no core, and keeps arguments of its build."""

    def __init__(self, *, works_in_background: bool) -> None:
        super().__init__()
        self.works_in_background = works_in_background
        self.handle = _Handle()
        self.built_with: tuple[Any, ...] = ()

    def spawn(self, plans: Sequence[ProcessPlan], build: Callable[..., Any], *arguments: Any) -> list[LocalHandle[Any]]:
        self.built_with = arguments
        return [self.handle]


@pytest.mark.parametrize("works_in_background", [False, True])
def test_workers_in_the_background_know_which_update_comes_first(works_in_background: bool) -> None:
    backend, config = _Backend(works_in_background=works_in_background), tiny_config(num_updates=8)
    ColocatedTrainer(config, backend, []).start(7, None)
    assert backend.built_with == (config, 7 if works_in_background else None)
    assert backend.handle.calls == [("start", None)]


def test_kernels_are_launched_as_they_were_traced_in_whatever_thread():
    """Warp keeps the number of a launch in an object that all traces of a kernel share."""
    launched = []

    class Kernel:
        launch_id = 0

        def __call__(self, *tables: Any, launch_dims: int, output_dims: Any) -> list[Any]:
            time.sleep(0.05)  # another thread traces meanwhile
            launched.append((tables[-1], launch_dims, self.launch_id))
            return [*tables[ffi.STATE_ARGUMENT : -1], jnp.zeros(output_dims["out_table"], jnp.int32)]

    kernel = Kernel()

    def trace(num_steps: int) -> None:
        table = jax.ShapeDtypeStruct((2, num_steps), jnp.float32)
        jax.eval_shape(ffi._launch(lambda worlds: (cast(ffi.KernelCall, kernel), worlds), 1, num_steps), *[table] * 7)

    threads = [threading.Thread(target=trace, args=(number,)) for number in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(launched) == [(number, number, (number << 32) | number) for number in (1, 2, 3)]


def test_waiting_for_programs_raises_errors_of_their_compilation():
    programs, may_end = Ahead(), threading.Event()

    def compile_two() -> None:
        programs.begin(fail)

    def fail() -> None:
        may_end.wait()
        raise ValueError("too large")

    programs.begin(compile_two)
    threading.Timer(0.1, may_end.set).start()
    with pytest.raises(ValueError, match="too large"):
        programs.wait()
    with pytest.raises(ValueError, match="too large"):  # the next call cannot go on without, either
        programs.wait()


def test_who_waits_for_programs_is_said_to_compile():
    """Else the limit of an update would end a run whose programs take longer."""
    programs, may_end = Ahead(), threading.Event()

    def wait() -> None:
        may_end.wait()

    programs.begin(wait)
    waiting = threading.Thread(target=programs.wait)
    waiting.start()
    try:
        assert waiting.ident is not None
        assert _doing(waiting.ident, "run_update", 0.0).is_compiling
    finally:
        may_end.set()
        waiting.join()
    assert not programs._jobs


def test_jobs_see_the_context_of_who_began_them():
    number, seen = contextvars.ContextVar("number", default=0), []
    number.set(3)
    programs = Ahead()
    programs.begin(lambda: seen.append(number.get()))
    programs.wait()
    programs.wait()  # costs nothing
    assert seen == [3]
