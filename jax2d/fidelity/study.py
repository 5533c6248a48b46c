"""The study: every scene under every setting, its error and its cost, and the same for peers.

scenes x cases (`sweep.py`) -> records
1. all trajectories and their errors; 2. all costs, interleaved (`interleaved_timing.py`), in batches of `worlds`;
3. records.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from jax2d.fidelity.frontier import NOT_ACCEPTED
from jax2d.fidelity.interleaved_timing import FAILURES, TimedRun, one_line, time_interleaved
from jax2d.fidelity.peers import PEERS, PeerFailed, PeerMissing, run_peer
from jax2d.fidelity.records import Record, setting_label
from jax2d.fidelity.references import TRUST
from jax2d.fidelity.simulator import Scenario, Simulator
from jax2d.fidelity.study_scene import Error, StudyScene
from jax2d.fidelity.sweep import Case
from jax2d.fidelity.units import with_plain_friction
from jax2d.scene import Capacity

XLA_WORLDS_SHARE = 1 / 16  # plain JAX costs about as much a world with fewer worlds, and far more than the kernel


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measurement:
    """Measurement of costs: repeats, batch, steps."""

    worlds: int
    steps: int  # of one timed run
    repeats: int = 5


class SceneGroup(NamedTuple):
    """The scenes of one capacity, built."""

    capacity: Capacity
    scenes: list[StudyScene]
    scenarios: list[Scenario]
    errors: list[Error]


class UntimedRecord(NamedTuple):
    """A record whose cost is still to be timed."""

    fields: dict[str, Any]
    timed: TimedRun


def run_study(
    scenes: Sequence[StudyScene],
    cases: Sequence[Case],
    peers: Sequence[str],
    measurement: Measurement,
    *,
    quick: bool,
    report: Callable[[str], None],
    keep: Callable[[list[Record]], None],
) -> tuple[list[Record], list[str]]:
    """Returns all records, and one line for each failure that has none. What cannot run here at all (a preset that a
    backend does not know, a peer that is not installed) is reported and is no failure. `keep` gets the records after
    every timed round, with the costs so far, so that a study that is cut short leaves something."""
    groups = _groups(scenes)
    untimed: list[UntimedRecord] = []
    failures: list[str] = []
    with contextlib.ExitStack() as stack:
        for number, case in enumerate(cases, 1):
            report(f"{number}/{len(cases)} {case.name}")
            for group in groups:
                simulator = Simulator(capacity=group.capacity, backend=case.backend, dtype=case.dtype)
                try:
                    simulator.engine(case.settings)
                    untimed += _case_records(group, case, simulator, measurement)
                except FAILURES as error:
                    failures.append(f"{case.name}: {one_line(error)}")
                    report(f"failed: {failures[-1]}")
                except ValueError as error:
                    report(f"{case.name} left out: {error}")
            if case.backend == "xla":  # a program takes 3,000 memory mappings, of which Linux allows a process 65,530
                jax.clear_caches()
        for name in peers:
            for group in groups:
                try:
                    untimed += _peer_records(stack, group, name, measurement, quick=quick, report=report)
                except PeerMissing as missing:
                    report(str(missing))
                    break
                except PeerFailed as error:
                    failures.append(str(error))
                    report(f"failed: {error}")
        runs = list(dict.fromkeys(one.timed for one in untimed))
        time_interleaved(runs, repeats=measurement.repeats, report=report, after_round=lambda: keep(_timed(untimed)))
    failures += [run.failure for run in runs if run.failure is not None]
    return _timed(untimed), failures


def _timed(records: Sequence[UntimedRecord]) -> list[Record]:
    return [Record(**one.fields, us_per_world_second=one.timed.cost) for one in records if one.timed.failure is None]


def _groups(scenes: Sequence[StudyScene]) -> list[SceneGroup]:
    groups: dict[Capacity, SceneGroup] = {}
    for scene in scenes:
        world, error = scene.world()
        group = groups.setdefault(scene.capacity, SceneGroup(scene.capacity, [], [], []))
        group.scenes.append(scene)
        group.scenarios.append(Scenario(world=world, seconds=scene.seconds, control=scene.control))
        group.errors.append(error)
    return list(groups.values())


def _case_records(group: SceneGroup, case: Case, simulator: Simulator, measurement: Measurement) -> list[UntimedRecord]:
    settings = with_plain_friction(case.settings)
    worlds = measurement.worlds
    if case.backend == "xla" and jax.default_backend() == "cpu":
        worlds = max(1, round(worlds * XLA_WORLDS_SHARE))
    results = simulator.run(group.scenarios, settings)
    cost = functools.partial(
        simulator.microseconds_per_world_second, settings=settings, worlds=worlds, steps=measurement.steps
    )
    runs = [
        TimedRun(f"{case.name}, {scene.name}", functools.partial(cost, result.timing))
        for scene, result in zip(group.scenes, results)
    ]
    common = {
        "preset": case.preset,
        "backend": case.backend,
        "dtype": case.dtype,
        "device": jax.devices()[0].device_kind,
        "setting": setting_label(case.settings),
    }
    return [
        UntimedRecord(
            fields_of(scene, error(result.trajectory), common), run if case.cost_depends_on_scene else runs[0]
        )
        for scene, error, result, run in zip(group.scenes, group.errors, results, runs)
    ]


def _peer_records(
    stack: contextlib.ExitStack,
    group: SceneGroup,
    name: str,
    measurement: Measurement,
    *,
    quick: bool,
    report: Callable[[str], None],
) -> list[UntimedRecord]:
    peer = PEERS[name]
    chosen = [i for i, scene in enumerate(group.scenes) if not scene.needs_joint_force]
    report(f"{peer.name}: {len(chosen)} scenes")
    peer_run = stack.enter_context(
        run_peer(
            peer,
            [group.scenarios[i] for i in chosen],
            batch=measurement.worlds,
            num_settings=1 if quick and name == "published" else len(peer.settings),
        )
    )
    records = []
    for k, label in enumerate(peer_run.labels):
        common = {
            "preset": peer.name,
            "backend": peer.backend,
            "dtype": peer.dtype,
            "device": peer_run.device,
            "setting": label,
        }
        runs = [
            TimedRun(f"{peer.name} ({label}), {group.scenes[i].name}", functools.partial(peer_run.cost, k, at))
            for at, i in enumerate(chosen)
        ]
        records += [
            UntimedRecord(
                fields_of(group.scenes[i], group.errors[i](peer_run.trajectories[k][at]), common),
                runs[at if peer.cost_depends_on_scene else 0],
            )
            for at, i in enumerate(chosen)
        ]
    return records


def fields_of(scene: StudyScene, error: float, common: dict[str, Any]) -> dict[str, Any]:
    """A record's fields but for its cost. The metric says where the error is too small for the truth to tell."""
    metric = scene.metric
    if error < TRUST * scene.uncertainty:
        metric += f"{NOT_ACCEPTED}less than {TRUST:g} x the {scene.uncertainty:.0e} to which the reference agrees"
    return {"scene": scene.name, **common, "metric": metric, "error": float(error) if math.isfinite(error) else None}
