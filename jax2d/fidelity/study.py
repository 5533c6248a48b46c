"""The study: every scene under every setting, its error and its cost, and the same for peers.

scenes x (presets, and sweeps of dt, of substeps or iterations and of warm starting around them) -> records
1. all motions and their errors; 2. all costs, in turns (`turns.py`), in batches of `worlds`; 3. records.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax

from jax2d.fidelity.closed_forms import with_plain_friction
from jax2d.fidelity.frontier import NOT_ACCEPTED, Record
from jax2d.fidelity.labels import setting_label
from jax2d.fidelity.peers import PEERS, PeerFailed, PeerMissing, peer_motions
from jax2d.fidelity.references import TRUST
from jax2d.fidelity.simulate import Group
from jax2d.fidelity.study_scene import Error, StudyScene
from jax2d.fidelity.turns import FAILURES, Turn, one_line, take_turns
from jax2d.scene import Capacity
from jax2d.settings import Settings, preset

RATES = (30, 60, 120, 240, 480)  # 1/dt
SUBSTEPS = (1, 2, 4, 8, 16)
ITERATIONS = (5, 10, 20, 40)
STIFF_HERTZ = 1000.0  # above any cap of a share of 1/h: the caps alone act
TOO_SLOW = {"reference": "a second of it takes longer than the rest of the study"}  # preset: why it is left out
XLA_WORLDS_SHARE = 1 / 16  # plain JAX costs about as much a world with fewer worlds, and far more than the kernel


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """Settings to run, and the preset they vary."""

    preset: str
    settings: Settings
    backend: str = "warp"
    dtype: str = "float32"

    @property
    def name(self) -> str:
        return f"{self.preset} ({setting_label(self.settings)}) on {self.backend} {self.dtype}"

    @property
    def cost_follows_motion(self) -> bool:
        """Plain JAX computes every pair and slot, in use or not: one scene's cost is that of all."""
        return self.backend == "warp"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measurement:
    """How costs are measured."""

    worlds: int
    steps: int  # of one timed run
    repeats: int = 5


class Part(NamedTuple):
    """The scenes of one capacity, built."""

    capacity: Capacity
    scenes: list[StudyScene]
    worlds: list[Any]
    errors: list[Error]


class Measured(NamedTuple):
    """A record whose cost is still to be timed."""

    fields: dict[str, Any]
    turn: Turn


def sweep(presets: Sequence[str], backends: Sequence[str], *, quick: bool) -> list[Case]:
    """The cases, presets themselves first. Sweeps run on the kernel; plain JAX shows the presets in both precisions."""
    cases: dict[Case, None] = {}
    if "warp" in backends:
        for name in presets:
            if name not in TOO_SLOW:
                cases[Case(preset=name, settings=preset(name))] = None
        for name in presets:
            if name in ("standard", "paper"):
                known = {setting_label(case.settings) for case in cases}
                for settings in _around(preset(name), quick=quick):
                    if setting_label(settings) not in known:  # another preset's own point
                        cases[Case(preset=name, settings=settings)] = None
            elif name not in TOO_SLOW and not quick:
                cases[Case(preset=name, settings=preset(name).replace(warm_start=False))] = None
    if "xla" in backends:
        for dtype in ("float32", "float64"):
            for name in presets:
                if name not in TOO_SLOW:
                    cases[Case(preset=name, settings=preset(name), backend="xla", dtype=dtype)] = None
    return list(cases)


def _around(base: Settings, *, quick: bool) -> Iterator[Settings]:
    """dt at the preset's own count, the count at the preset's own dt; all pairs in the full study. For soft_step also
    with stiffness caps that rise with the sub-steps, since fixed ones leave an error that no sub-step lowers."""
    counts = SUBSTEPS if base.solver == "soft_step" else ITERATIONS
    for rate in RATES:
        for count in counts:
            if not quick or rate == 60 or count == base.substeps:
                yield base.replace(dt=1 / rate, substeps=count)
    for count in (base.substeps,) if quick else counts:
        yield base.replace(substeps=count, warm_start=False)
    if base.solver == "soft_step":
        for rate in (60,) if quick else RATES:
            for count in (8, 16):
                stiff = base.replace(contact_hertz=STIFF_HERTZ, joint_hertz=STIFF_HERTZ)
                yield stiff.replace(dt=1 / rate, substeps=count)


def run_study(
    scenes: Sequence[StudyScene],
    cases: Sequence[Case],
    peers: Sequence[str],
    measurement: Measurement,
    *,
    quick: bool,
    report: Callable[[str], None],
) -> tuple[list[Record], list[str]]:
    """All records, and one line for each thing that failed and has none. What cannot run here at all (a preset that a
    backend does not know, a peer that is not installed) is reported and is no failure."""
    parts = _parts(scenes)
    measured: list[Measured] = []
    failures: list[str] = []
    groups: dict[tuple[Capacity, str, str], Group] = {}
    with contextlib.ExitStack() as stack:
        for number, case in enumerate(cases, 1):
            report(f"{number}/{len(cases)} {case.name}")
            for part in parts:
                key = (part.capacity, case.backend, case.dtype)
                group = groups.setdefault(key, Group(*key))
                try:
                    group.engine(case.settings)
                    measured += _case_motions(part, case, group, measurement)
                except FAILURES as error:
                    failures.append(f"{case.name}: {one_line(error)}")
                    report(f"failed: {failures[-1]}")
                except ValueError as error:
                    report(f"{case.name} left out: {error}")
        for name in peers:
            for part in parts:
                try:
                    measured += _peer_motions(stack, part, name, measurement, quick=quick, report=report)
                except PeerMissing as missing:
                    report(str(missing))
                    break
                except PeerFailed as error:
                    failures.append(str(error))
                    report(f"failed: {error}")
        turns = list(dict.fromkeys(one.turn for one in measured))
        take_turns(turns, repeats=measurement.repeats, report=report)
    failures += [turn.failure for turn in turns if turn.failure is not None]
    return [
        Record(**one.fields, us_per_world_second=one.turn.cost) for one in measured if one.turn.failure is None
    ], failures


def _parts(scenes: Sequence[StudyScene]) -> list[Part]:
    parts: dict[Capacity, Part] = {}
    for scene in scenes:
        world, error = scene.world()
        part = parts.setdefault(scene.capacity, Part(scene.capacity, [], [], []))
        part.scenes.append(scene)
        part.worlds.append(world)
        part.errors.append(error)
    return list(parts.values())


def _case_motions(part: Part, case: Case, group: Group, measurement: Measurement) -> list[Measured]:
    settings = with_plain_friction(case.settings)
    worlds = measurement.worlds
    if case.backend == "xla" and jax.default_backend() == "cpu":
        worlds = max(1, round(worlds * XLA_WORLDS_SHARE))
    runs = group.paths(
        part.worlds, settings, [scene.seconds for scene in part.scenes], [scene.control for scene in part.scenes]
    )
    turns = [
        Turn(
            f"{case.name}, {scene.name}",
            functools.partial(
                group.microseconds_per_world_second, run.moments, settings, worlds=worlds, steps=measurement.steps
            ),
        )
        for scene, run in zip(part.scenes, runs)
    ]
    common = {
        "preset": case.preset,
        "backend": case.backend,
        "dtype": case.dtype,
        "device": jax.devices()[0].device_kind,
        "setting": setting_label(case.settings),
    }
    return [
        Measured(fields_of(scene, error(run.path), common), turn if case.cost_follows_motion else turns[0])
        for scene, error, run, turn in zip(part.scenes, part.errors, runs, turns)
    ]


def _peer_motions(
    stack: contextlib.ExitStack,
    part: Part,
    name: str,
    measurement: Measurement,
    *,
    quick: bool,
    report: Callable[[str], None],
) -> list[Measured]:
    peer = PEERS[name]
    told = [i for i, scene in enumerate(part.scenes) if not scene.needs_joint_force]
    report(f"{peer.name}: {len(told)} scenes")
    motions = stack.enter_context(
        peer_motions(
            peer,
            [part.worlds[i] for i in told],
            [part.scenes[i].seconds for i in told],
            [part.scenes[i].control for i in told],
            batch=measurement.worlds,
            num_settings=1 if quick and name == "published" else len(peer.settings),
        )
    )
    measured = []
    for k, label in enumerate(motions.labels):
        common = {
            "preset": peer.name,
            "backend": peer.backend,
            "dtype": peer.dtype,
            "device": motions.device,
            "setting": label,
        }
        turns = [
            Turn(f"{peer.name} ({label}), {part.scenes[i].name}", functools.partial(motions.cost, k, at))
            for at, i in enumerate(told)
        ]
        measured += [
            Measured(
                fields_of(part.scenes[i], part.errors[i](motions.paths[k][at]), common),
                turns[at if peer.cost_follows_motion else 0],
            )
            for at, i in enumerate(told)
        ]
    return measured


def fields_of(scene: StudyScene, error: float, common: dict[str, Any]) -> dict[str, Any]:
    """A record's fields but for its cost. The metric says where the error is too small for the truth to tell."""
    metric = scene.metric
    if error < TRUST * scene.uncertainty:
        metric += f"{NOT_ACCEPTED}less than {TRUST:g} x the {scene.uncertainty:.0e} to which the reference agrees"
    return {"scene": scene.name, **common, "metric": metric, "error": float(error) if math.isfinite(error) else None}
