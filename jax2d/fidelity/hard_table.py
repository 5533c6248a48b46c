"""Table of the hard scenes that each preset passes: `python -m jax2d.fidelity.hard_table [PRESET ...]` prints the
table."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence

from jax2d.effects import effects_of
from jax2d.engine import Engine
from jax2d.fidelity.arguments import OneLineParser
from jax2d.fidelity.hard_scenes import CAPACITY, Check, HardScene, hard_scenes
from jax2d.fidelity.trajectory import record_worlds
from jax2d.settings import PRESETS, Settings

REFUSED = "refused"  # what the table says of a scene that the solver does not have the effects for
SHOWN = ["standard", "fine", "draft", "paper"]  # preset reference is for float64


@functools.cache
def scenes() -> tuple[HardScene, ...]:
    return tuple(hard_scenes())


@functools.cache
def outcomes(settings: Settings) -> dict[str, list[Check] | None]:
    """Checks of every scene under the given settings, by the scene's name; None for one with an effect that the solver
    does not have. Scenes of equal length run as one batch."""
    engine = Engine(CAPACITY, settings=settings)
    results: dict[str, list[Check] | None] = {}
    known = [scene for scene in scenes() if engine.effects.covers(effects_of(scene.world.scene))]
    for seconds in sorted({scene.seconds for scene in known}):
        batch = [scene for scene in known if scene.seconds == seconds]
        for scene, trajectory in zip(batch, record_worlds(engine, [s.world for s in batch], seconds=seconds)):
            assert trajectory.overflow is not None
            overflow = Check("contacts without a slot", trajectory.overflow.sum(), 0)
            results[scene.name] = [*scene.checks(trajectory), overflow]
    return {scene.name: results.get(scene.name) for scene in scenes()}


def worst(checks: Sequence[Check]) -> Check:
    """The check that a row of the table shows: one that fails, or that comes closest to it."""

    def order(check: Check) -> tuple[bool, float]:
        ratio = check.value / check.limit if check.limit > 0 else float(check.value > check.limit)
        return (not check.holds, ratio)

    return max(checks, key=order)


def table(presets: Sequence[str]) -> str:
    """Markdown: a row a scene, a column a preset; each cell has the figure nearest to its limit (or beyond it)."""
    columns = {name: outcomes(PRESETS[name]) for name in presets}
    rows = [["scene", "figure, at most", *presets], ["---"] * (2 + len(presets))]
    for scene in scenes():
        checked = [columns[name][scene.name] for name in presets]
        first = worst(next(checks for checks in checked if checks is not None))
        rows.append([scene.name, f"{first.figure}: {first.limit:g}", *(_cell(checks, first) for checks in checked)])
    rows.append(["fails", "", *(str(sum(_fails(checks) for checks in columns[name].values())) for name in presets)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _cell(checks: Sequence[Check] | None, first: Check) -> str:
    if checks is None:
        return REFUSED
    shown = worst(checks)
    figure = "" if shown.figure == first.figure else f"{shown.figure}: "
    return f"{'' if shown.holds else '**fails** '}{figure}{shown.value:.2g}"


def _fails(checks: Sequence[Check] | None) -> bool:
    return checks is not None and not all(check.holds for check in checks)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = OneLineParser(prog="python -m jax2d.fidelity.hard_table", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "presets", nargs="*", metavar="PRESET", help=f"{', '.join(SHOWN)} by default, in seconds to minutes each"
    )
    presets = parser.parse_args(arguments).presets or SHOWN
    for name in presets:
        if name not in SHOWN:
            parser.error(f"unknown preset {name!r}; known: {', '.join(SHOWN)}")
    sys.stdout.write(table(presets) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
