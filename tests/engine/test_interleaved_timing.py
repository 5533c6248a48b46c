"""Interleaved timing: each setting once a round, and what fails does not take the others with it."""

from __future__ import annotations

import pytest

from jax2d.fidelity.interleaved_timing import TimedRun, time_interleaved


def test_all_run_once_before_any_runs_again():
    order = []

    def run(name: str) -> float:
        order.append(name)
        return float(len(order))

    runs = [TimedRun(name, lambda name=name: run(name)) for name in "ab"]
    so_far: list[float] = []
    time_interleaved(runs, repeats=3, report=lambda line: None, after_round=lambda: so_far.append(runs[1].cost))
    assert "".join(order) == "ab" * 4
    assert so_far == [4.0, 5.0, 6.0]  # what a study that is cut short leaves
    assert runs[0].costs == [3.0, 5.0, 7.0]  # the first round warms up
    assert runs[0].cost == 5.0


def test_what_fails_is_not_run_again_and_the_rest_goes_on():
    tries = []

    def fails() -> float:
        tries.append(1)
        raise MemoryError("out of\nmemory")

    said: list[str] = []
    bad, good = TimedRun("bad", fails), TimedRun("good", lambda: 2.0)
    time_interleaved([bad, good], repeats=5, report=said.append)
    assert len(tries) == 1
    assert bad.failure == "bad: out of memory"
    assert "failed: bad: out of memory" in said
    assert (good.failure, good.cost, len(good.costs)) == (None, 2.0, 5)


def test_a_mistake_in_the_program_is_not_taken_for_a_failure():
    def wrong() -> float:
        raise TypeError("a bug")

    with pytest.raises(TypeError):
        time_interleaved([TimedRun("wrong", wrong)], repeats=1, report=lambda line: None)
