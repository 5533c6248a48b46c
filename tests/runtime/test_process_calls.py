"""Calls of processes: how arguments travel, and which calls the type checker refuses."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.runtime.processes.calls import Future
from kinetix_dist.runtime.processes.local import LocalHandle
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.runtime.processes.ray_calls import actors_of
from tests.helpers import REPOSITORY

WRONG = "# wrong"
RIGHT_AND_WRONG = """
from typing import Any

import numpy as np

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.cores.build import build_learner, build_rollout
from kinetix_dist.runtime.cores.curator_core import CuratorCore
from kinetix_dist.runtime.cores.split_core import RolloutWorker
from kinetix_dist.runtime.cores.worker import LearnerWorker, Worker
from kinetix_dist.runtime.processes.backend import Backend
from kinetix_dist.runtime.processes.calls import Future, Group, Handle
from kinetix_dist.runtime.processes.placement import ProcessPlan


def calls(learner: Handle[LearnerWorker], worker: Handle[Worker], actor: Handle[RolloutWorker], params: Any) -> None:
    learner.call(LearnerWorker.probe, 8)
    learner.call(LearnerWorker.probe, "8")  # wrong
    learner.call(LearnerWorker.probe)  # wrong
    learner.call(LearnerWorker.probe, 8, 9)  # wrong
    learner.call(LearnerWorker.probes, 8)  # wrong
    learner.call("probe", 8)  # wrong
    worker.call(Worker.probe, num_levels=8)
    worker.call(Worker.probe, number=8)  # wrong
    learner.call(Worker.ongoing_worlds)  # wrong
    learner.call(CuratorCore.prepare, 3)  # wrong

    header, content = actor.call_with_header(RolloutWorker.play, 1, 0, params, None)
    actor.call_with_header(RolloutWorker.play, "1", 0, params, None)  # wrong
    learner.call_with_header(LearnerWorker.facts)  # wrong
    learner.call_in_background(LearnerWorker.stage, 1, 0, 2, content)
    learner.call_in_background(LearnerWorker.stage, 1, 0, content)  # wrong
    learner.call_in_background(LearnerWorker.stage, 1, 0, 2, header)  # wrong


def answers(learner: Handle[LearnerWorker], backend: Backend, arrays: dict[str, np.ndarray]) -> None:
    stored = backend.put(arrays)
    learner.call(LearnerWorker.state_from, 3, stored.as_argument())
    learner.call(LearnerWorker.state_from, 3, stored)  # wrong
    learner.call(LearnerWorker.state_from, 3, backend.put(8).as_argument())  # wrong
    snapshot: Future[dict[str, np.ndarray]] = learner.call(LearnerWorker.snapshot)
    backend.gather([snapshot])[0].keys()
    backend.gather([snapshot])[0].append(1)  # wrong


def starts(backend: Backend, plans: list[ProcessPlan], config: TrainConfig) -> None:
    learners, actors = backend.spawn_both(
        Group(plans, build_learner, config), Group(plans, build_rollout, config, 2)
    )
    learners[0].call(LearnerWorker.facts)
    actors[0].call(LearnerWorker.facts)  # wrong
    Group(plans, build_rollout, config)  # wrong
    backend.spawn(plans, build_rollout, config, "2")  # wrong
"""


class Adder:
    def add(self, a: int, b: int) -> int:
        return a + b

    def with_header(self, a: int) -> tuple[dict[str, Any], int]:
        return {"a": a}, 2 * a

    def doubled(self, number: Future[int]) -> int:
        return 2 * number.fetch()


class LoudAdder(Adder):
    def add(self, a: int, b: int) -> int:
        return 100 * super().add(a, b)


def handle_of(core: Adder) -> LocalHandle[Adder]:
    return LocalHandle(ProcessPlan(role="worker", index=0), core)


def test_a_future_is_an_argument_by_position_or_name() -> None:
    handle = handle_of(Adder())
    three = handle.call(Adder.add, 1, b=2)
    assert three.fetch() == 3
    assert handle.call(Adder.add, three.as_argument(), b=three.as_argument()).fetch() == 6
    header, content = handle.call_with_header(Adder.with_header, a=three.as_argument())
    assert (header.fetch(), content.fetch()) == ({"a": 3, "put": (0, 0.0)}, 6)
    assert handle.call_in_background(Adder.doubled, number=three).fetch() == 6  # the method fetches it


def test_a_call_reaches_the_method_of_a_subclass() -> None:
    assert handle_of(LoudAdder()).call(Adder.add, 1, 2).fetch() == 300


def test_handles_of_another_backend_are_refused() -> None:
    with pytest.raises(TypeError, match="LocalHandle belongs to another backend"):
        actors_of([handle_of(Adder())])


def lines_with_errors(source: str, folder: Path) -> set[int]:
    """Return the numbers of the lines that the type checker complains about."""
    file = folder / "calls.py"
    file.write_text(source)
    command = [sys.executable, "-m", "pyrefly", "check", "--preset", "default", "--output-format", "json"]
    command += ["--search-path", str(REPOSITORY), "--python-interpreter-path", sys.executable, str(file)]
    checked = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert checked.returncode in (0, 1), checked.stderr
    return {error["line"] for error in json.loads(checked.stdout)["errors"] if error["severity"] == "error"}


def test_the_type_checker_refuses_wrong_calls_and_no_other(tmp_path: Path) -> None:
    marked = {number for number, line in enumerate(RIGHT_AND_WRONG.splitlines(), 1) if line.endswith(WRONG)}
    assert lines_with_errors(RIGHT_AND_WRONG, tmp_path) == marked
