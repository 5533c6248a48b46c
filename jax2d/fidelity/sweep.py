"""Settings that the study runs: the presets, and sweeps of dt, of sub-steps or iterations and of warm starting."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

from jax2d.fidelity.records import setting_label
from jax2d.settings import Settings, fastest_spin, preset

RATES = (30, 60, 120, 240, 480)  # 1/dt
SUBSTEPS = (1, 2, 4, 8, 16)
ITERATIONS = (5, 10, 20, 40)
STIFF_HERTZ = 1000.0  # above any cap of a share of 1/h: the caps alone act
TOO_SLOW = {"reference": "a second of it takes longer than the rest of the study"}  # preset: why it is left out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """Settings to run, and the preset that they vary."""

    preset: str
    settings: Settings
    backend: str = "warp"
    dtype: str = "float32"

    @property
    def name(self) -> str:
        return f"{self.preset} ({setting_label(self.settings)}) on {self.backend} {self.dtype}"

    @property
    def cost_depends_on_scene(self) -> bool:
        """Plain JAX computes every pair and slot, in use or not: one scene's cost is that of all."""
        return self.backend == "warp"


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
                yield _at(base, 1 / rate, count)
    for count in (base.substeps,) if quick else counts:
        yield _at(base, base.dt, count).replace(warm_start=False)
    if base.solver == "soft_step":
        for rate in (60,) if quick else RATES:
            for count in (8, 16):
                stiff = base.replace(contact_hertz=STIFF_HERTZ, spring_hertz=STIFF_HERTZ)
                yield _at(stiff, 1 / rate, count)


def _at(base: Settings, dt: float, count: int) -> Settings:
    """Other steps, with the limit of spin that they admit: bodies of the study turn at less."""
    limit = base.max_angular_speed
    if base.solver == "soft_step":
        limit = min(limit, fastest_spin(dt, count))
    return base.replace(dt=dt, substeps=count, max_angular_speed=limit)
