"""Sinks of a run: metrics, evaluations, events and the configuration reach every sink, also where a run goes back."""

from __future__ import annotations

import dataclasses
import json
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from kinetix_dist.config import EvaluationConfig, RunConfig, to_dict
from kinetix_dist.runtime.driver.reporting import RunReporter
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.training_run import train
from kinetix_dist.setting import ConfigError
from kinetix_dist.telemetry.names import describe
from kinetix_dist.telemetry.sinks import SINKS, Evaluation, Sink, SinkRun
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from tests.runtime.runs import tiny_config

SET = "s/kick"
NUM_UPDATES, EVERY = 4, 2


class Spy(Sink):
    """Stores what it gets: (method, arguments), by part."""

    parts: list[tuple[SinkRun, list[tuple[str, Any]]]] = []
    fails_at: int | None = None  # the metrics of this update fail, once

    def __init__(self, run: SinkRun) -> None:
        self.run, self.calls = run, []
        Spy.parts.append((run, self.calls))

    def metrics(self, update: int, metrics: Mapping[str, float]) -> None:
        if update == Spy.fails_at:
            Spy.fails_at = None
            raise ConnectionError("the service is away")
        self.calls.append(("metrics", (update, metrics)))

    def evaluated(self, evaluation: Evaluation) -> None:
        self.calls.append(("evaluated", evaluation))

    def event(self, event: Mapping[str, Any]) -> None:
        self.calls.append(("event", event))

    def close(self) -> None:
        self.calls.append(("close", threading.current_thread().name))


SINKS.register("spy", Spy)


@pytest.fixture(autouse=True)
def no_parts() -> Iterator[None]:
    yield
    Spy.parts, Spy.fails_at = [], None


def quiet() -> ConsoleSink:
    return ConsoleSink(total_env_steps=None, console=Console(quiet=True))


def updates_of(calls: list[tuple[str, Any]]) -> list[int]:
    return [update for name, (update, _) in ((n, v) for n, v in calls if n == "metrics")]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple[SinkRun, list[tuple[str, Any]]]]]:
    """A run of NUM_UPDATES that was resumed for as many again, and what the spy got of both sessions."""
    path = tmp_path_factory.mktemp("sinks") / "run"
    for session in (1, 2):
        config = tiny_config(num_updates=session * NUM_UPDATES, placement="local", sinks=("tensorboard", "spy"))
        config = dataclasses.replace(
            config,
            evaluation=EvaluationConfig(sets=(SET,), min_attempts=4, every=EVERY),
            recording=dataclasses.replace(config.recording, num_rollouts=0),
        )
        run = RunDirectory.create(path, numbered=False) if session == 1 else RunDirectory.open_existing(path)
        try:
            train(config, run, resume=session == 2, console=quiet())
        finally:
            run.close()
    return path, Spy.parts


@pytest.mark.long
def test_every_update_evaluation_and_event_reaches_a_sink(trained: Any) -> None:
    path, parts = trained
    assert [updates_of(calls) for _, calls in parts] == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert [[(e.phase, e.update) for n, e in calls if n == "evaluated"] for _, calls in parts] == [
        [("random_policy", 0), ("before", 0), ("training", 2), ("training", 4), ("after", 4)],
        [("training", 6), ("training", 8), ("after", 8)],
    ]
    events = [event for _, calls in parts for name, event in calls if name == "event"]
    assert events == [json.loads(line) for line in (path / "events.jsonl").read_text().splitlines()]
    assert {"run_started", "resumed", "run_finished"} <= {event["event"] for event in events}
    assert all(Counter(name for name, _ in calls)["close"] == 1 and calls[-1][0] == "close" for _, calls in parts)


@pytest.mark.long
def test_a_sink_is_told_which_part_of_the_run_it_is_for(trained: Any) -> None:
    path, ((first, _), (second, _)) = trained
    stored = json.loads((path / "config.json").read_text())
    assert (second.config, second.config_hash) == (stored["config"], stored["hash"])
    assert first.config["run"]["sinks"] == ["tensorboard", "spy"]
    assert (first.name, first.directory, first.session, first.resume_at, first.from_env_steps) == ("run", path, 1, 0, 0)
    steps = tiny_config(num_updates=1).rollout.steps_per_update
    assert (second.session, second.resume_at, second.from_env_steps) == (2, NUM_UPDATES, (NUM_UPDATES + 1) * steps)
    assert first.id != second.id


@pytest.mark.long
def test_metrics_of_a_sink_are_described_and_evaluations_come_apart(trained: Any) -> None:
    _, parts = trained
    for name, value in (call for _, calls in parts for call in calls):
        if name == "metrics":
            assert not [metric for metric in value[1] if metric.startswith("evaluation/")]
        if name == "evaluated":
            assert value.metrics and all(describe(metric) for metric in value.metrics)


@pytest.mark.long
def test_tensorboard_reads_evaluations_at_the_steps_of_their_policy(trained: Any) -> None:
    path, _ = trained
    read = EventAccumulator(str(path / "metrics"))
    read.Reload()
    steps = tiny_config(num_updates=1).rollout.steps_per_update
    rows = [json.loads(line) for line in (path / "evaluations.jsonl").read_text().splitlines()]
    expected = {row["update"]: row["sets"][SET] for row in rows if row["phase"] != "random_policy"}
    for name in ("solve_rate", "low", "high"):
        points = {point.step: point.value for point in read.Scalars(f"evaluation/{SET}/{name}")}
        assert sorted(points) == [update * steps for update in (0, 2, 4, 6, 8)]
        if name == "solve_rate":
            rates = {update: sum(found["solved"]) / found["attempts"] for update, found in expected.items()}
            assert points == pytest.approx({update * steps: rate for update, rate in rates.items()})
    [random] = read.Scalars(f"evaluation/{SET}/random_actions")
    assert random.step == 0
    losses = [point.step for point in read.Scalars("progress/updates")]
    assert losses == [update * steps for update in range(1, 2 * NUM_UPDATES + 1)]


def row(update: int) -> dict[str, float]:
    return {"progress/env_steps": 8.0 * update, "progress/updates": float(update)}


def test_tensorboard_has_evaluations_before_and_after_training(tmp_path: Path) -> None:
    """As those of `quickstart`, which evaluates at no other time."""
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = RunReporter(run, quiet())
    for phase, update, rate in (("random_policy", 0, 0.1), ("before", 0, 0.2), ("after", 3, 0.5)):
        for number in range(1, update + 1):
            reporter.metrics(number, row(number), None)
        rates = {SET: {"rate": rate, "low": rate - 0.1, "high": rate + 0.1, "attempts": 100}}
        reporter.evaluated(
            Evaluation(phase=phase, update=update, env_steps=8 * update, reported_at=update, rates=rates)
        )
    reporter.close()
    run.close()
    read = EventAccumulator(str(run.metrics))
    read.Reload()
    points = {
        name: [(point.step, round(point.value, 3)) for point in read.Scalars(f"evaluation/{SET}/{name}")]
        for name in ("solve_rate", "low", "high", "random_actions")
    }
    assert points == {
        "solve_rate": [(0, 0.2), (24, 0.5)],
        "low": [(0, 0.1), (24, 0.4)],
        "high": [(0, 0.3), (24, 0.6)],
        "random_actions": [(0, 0.1)],
    }
    assert [point.step for point in read.Scalars("progress/updates")] == [8, 16, 24]


def test_where_a_run_goes_back_sinks_are_opened_for_another_part(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = RunReporter(run, quiet(), sinks=("spy", "tensorboard"))
    for update in (1, 2, 3, 2, 3):  # a loss in update 4: back to the checkpoint of 1
        reporter.metrics(update, row(update), None)
    reporter.close()
    run.close()
    assert [(part.resume_at, part.from_env_steps, updates_of(calls)) for part, calls in Spy.parts] == [
        (0, 8, [1, 2, 3]),
        (1, 16, [2, 3]),
    ]
    read = EventAccumulator(str(run.metrics))
    read.Reload()
    assert [point.step for point in read.Scalars("progress/updates")] == [8, 16, 24]


def test_a_sink_that_fails_is_reported_opened_again_for_the_same_part_and_costs_one_row(tmp_path: Path) -> None:
    Spy.fails_at = 2
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = RunReporter(run, quiet(), sinks=("spy",))
    for update in (1, 2, 3):
        reporter.metrics(update, row(update), None)
    reporter.close()
    run.close()
    assert [updates_of(calls) for _, calls in Spy.parts] == [[1], [3]]
    assert len({part.id for part, _ in Spy.parts}) == 1
    events = [json.loads(line) for line in run.events.read_text().splitlines()]
    [failing] = [event for event in events if event["event"] == "sink_failing"]
    assert failing["sink"] == "spy" and "the service is away" in failing["error"]


def test_a_run_without_sinks_has_its_own_files(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = RunReporter(run, quiet(), sinks=())
    reporter.metrics(1, row(1), None)
    reporter.close()
    run.close()
    assert [path.name for path in run.metrics.iterdir()] == ["metrics.jsonl"]


def test_an_unknown_sink_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(ConfigError, match=r"RunConfig.sinks: unknown sink 'tensorbord'; .*tensorboard"):
        RunConfig(max_seconds=1.0, sinks=("tensorbord",))
    assert to_dict(tiny_config(num_updates=1))["run"]["sinks"] == ["tensorboard"]
