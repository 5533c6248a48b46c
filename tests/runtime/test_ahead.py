"""A worker runs the programs that were compiled ahead; what fails in a thread is raised where it is waited for."""

from __future__ import annotations

import contextvars
import threading
from collections.abc import Iterator

import jax
import numpy as np
import pytest

from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.runtime.cores import ahead
from kinetix_dist.runtime.cores.ahead import THREAD, Ahead
from kinetix_dist.runtime.cores.worker import Worker
from kinetix_dist.runtime.processes.actor import _doing
from tests.runtime.runs import tiny_config

LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"


@pytest.fixture
def lowered() -> Iterator[list[tuple[str, str]]]:
    """(function, thread) of every program that is lowered meanwhile."""
    found: list[tuple[str, str]] = []

    def listen(event: str, duration: float, **details: str | int) -> None:
        if event == LOWERED:
            found.append((str(details["fun_name"]), threading.current_thread().name))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)


# Of rollout, update and scoring.
PROGRAMS = {"jit(call)", "jit(update)", "jit(_score)"}


@pytest.mark.parametrize("is_resumed", [False, True])
def test_neither_refresh_nor_update_compile_again_what_was_compiled_ahead(lowered, is_resumed, monkeypatch):
    monkeypatch.setattr(ahead, "has_cores", lambda: True)
    config = tiny_config(num_updates=8, num_curators=0)
    before, mesh = Worker(config, data_mesh(jax.devices()[:1])), data_mesh(jax.devices()[:1])
    before.start(None)
    _, refreshed = before.refresh(before.released(), 0, 0, 1)
    before.adopt(refreshed)
    arrays, update = None, 0
    expected, *_ = before.run_update(0)
    if is_resumed:
        arrays, update = before.snapshot(), 1
        expected, *_ = before.run_update(1)

    jax.clear_caches()  # programs are kept for workers of equal settings
    lowered.clear()
    worker = Worker(config, mesh)
    worker.start(arrays, update)
    worker._ahead.wait()
    assert {name for name, thread in lowered if thread == THREAD} >= PROGRAMS
    lowered.clear()
    if not is_resumed:
        _, refreshed = worker.refresh(worker.released(), 0, 0, 1)
        worker.adopt(refreshed)
    metrics, *_ = worker.run_update(update)
    assert not PROGRAMS & {name for name, _ in lowered}
    np.testing.assert_equal(metrics, expected)


def test_a_refresh_and_an_update_wait_for_programs_and_raise_what_kept_them_from_being_compiled():
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
    with pytest.raises(ValueError, match="too large"):  # whoever asks next cannot go on without, either
        programs.wait()


def test_who_waits_for_programs_is_said_to_compile():
    """Else the limit of an update would end a run whose programs take longer."""
    programs, may_end = Ahead(), threading.Event()
    programs.begin(lambda: may_end.wait() and None)
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
