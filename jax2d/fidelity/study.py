"""The study: every closed form under every setting, its error and its cost, and the same for peers.

scenes x (presets, and sweeps of dt and of substeps or iterations around them) -> records
cost: microseconds per simulated world-second in a batch of `worlds`, median of `repeats` runs after warm-up
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import jax

from jax2d.fidelity.closed_forms import CAPACITY, ClosedForm, with_plain_friction
from jax2d.fidelity.frontier import Record
from jax2d.fidelity.peers import PEERS, PeerMissing, peer_runs
from jax2d.fidelity.simulate import Group
from jax2d.settings import PRESETS, Settings, preset

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measurement:
    """How costs are measured."""

    worlds: int
    steps: int = 32  # of one timed run
    repeats: int = 5


def setting_label(settings: Settings) -> str:
    """What of the settings is swept, in words."""
    count = f"{settings.substeps} substeps" if settings.solver == "soft_step" else f"{settings.substeps} iterations"
    label = f"dt 1/{round(1 / settings.dt)}, {count}"
    if settings.solver == "soft_step" and not math.isclose(settings.contact_hertz, Settings().contact_hertz):
        label += f", contacts to {settings.contact_hertz:g} Hz"
    return label


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
    if base.solver == "soft_step":
        for rate in (60,) if quick else RATES:
            for count in (8, 16):
                stiff = base.replace(contact_hertz=STIFF_HERTZ, joint_hertz=STIFF_HERTZ)
                yield stiff.replace(dt=1 / rate, substeps=count)


def run_study(
    scenes: Sequence[ClosedForm],
    cases: Sequence[Case],
    peers: Sequence[str],
    measurement: Measurement,
    *,
    quick: bool,
    report: Callable[[str], None],
) -> list[Record]:
    """All records; a case or peer that cannot run is reported in one line and left out."""
    built = [scene.world() for scene in scenes]
    records: list[Record] = []
    groups: dict[tuple[str, str], Group] = {}
    for number, case in enumerate(cases, 1):
        group = groups.setdefault((case.backend, case.dtype), Group(CAPACITY, case.backend, case.dtype))
        name = f"{case.preset} ({setting_label(case.settings)}) on {case.backend} {case.dtype}"
        try:
            group.engine(case.settings)
        except ValueError as error:
            report(f"{name} left out: {error}")
            continue
        report(f"{number}/{len(cases)} {name}")
        records += _case_records(scenes, built, case, group, measurement)
    for name in peers:
        try:
            records += _peer_records(scenes, built, name, measurement, quick=quick, report=report)
        except PeerMissing as missing:
            report(str(missing))
    return records


def _case_records(
    scenes: Sequence[ClosedForm], built: Sequence, case: Case, group: Group, measurement: Measurement
) -> list[Record]:
    settings = with_plain_friction(case.settings)
    worlds = measurement.worlds
    if case.backend == "xla" and jax.default_backend() == "cpu":
        worlds = max(1, round(worlds * XLA_WORLDS_SHARE))
    runs = group.paths(
        [world for world, _ in built], settings, [s.seconds for s in scenes], [s.control for s in scenes]
    )
    records = []
    for scene, (_, error), run in zip(scenes, built, runs):
        cost = group.microseconds_per_world_second(
            run, settings, worlds=worlds, steps=measurement.steps, repeats=measurement.repeats
        )
        records.append(
            Record(
                scene=scene.name,
                preset=case.preset,
                backend=case.backend,
                dtype=case.dtype,
                device=jax.devices()[0].device_kind,
                setting=setting_label(case.settings),
                metric=scene.metric,
                error=_finite(error(run.path)),
                us_per_world_second=cost,
            )
        )
    return records


def _peer_records(
    scenes: Sequence[ClosedForm],
    built: Sequence,
    name: str,
    measurement: Measurement,
    *,
    quick: bool,
    report: Callable[[str], None],
) -> list[Record]:
    told = [(scene, *both) for scene, both in zip(scenes, built) if not scene.needs_joint_force]
    peer = PEERS[name]
    report(f"{peer.name}: {len(told)} scenes")
    runs = peer_runs(
        peer,
        [world for _, world, _ in told],
        [scene.seconds for scene, _, _ in told],
        [scene.control for scene, _, _ in told],
        batch=measurement.worlds,
        steps=8,
        repeats=measurement.repeats,
        num_settings=1 if quick and name == "published" else len(peer.settings),
    )
    return [
        Record(
            scene=scene.name,
            preset=peer.name,
            backend=peer.backend,
            dtype=peer.dtype,
            device=runs.device,
            setting=label,
            metric=scene.metric,
            error=_finite(error(path)),
            us_per_world_second=cost,
        )
        for label, paths, costs in zip(runs.labels, runs.paths, runs.microseconds)
        for (scene, _, error), path, cost in zip(told, paths, costs)
    ]


def _finite(error: float) -> float | None:
    return float(error) if math.isfinite(error) else None


def is_preset_itself(record: Record) -> bool:
    """Whether a record's setting is that of its preset, unswept."""
    name = record["preset"]
    return name in PRESETS and setting_label(PRESETS[name]) == record["setting"]
