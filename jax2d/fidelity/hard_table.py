"""Which preset passes which hard scene: `python -m jax2d.fidelity.hard_table [PRESET ...]` prints the table."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence

from jax2d.engine import Engine
from jax2d.fidelity.arguments import OneLineParser
from jax2d.fidelity.hard_scenes import CAPACITY, Check, HardScene, hard_scenes
from jax2d.fidelity.trajectory import record_worlds
from jax2d.settings import PRESETS, Settings

SHOWN = ["standard", "fine", "draft", "paper"]  # preset reference is for float64


@functools.cache
def scenes() -> tuple[HardScene, ...]:
    return tuple(hard_scenes())


@functools.cache
def outcomes(settings: Settings) -> dict[str, list[Check]]:
    """Checks of every scene under the given settings, by the scene's name; scenes of equal length run as one batch."""
    engine = Engine(CAPACITY, settings=settings)
    results: dict[str, list[Check]] = {}
    for seconds in sorted({scene.seconds for scene in scenes()}):
        batch = [scene for scene in scenes() if scene.seconds == seconds]
        for scene, trajectory in zip(batch, record_worlds(engine, [s.world for s in batch], seconds=seconds)):
            overflow = Check("contacts without a slot", trajectory.overflow.sum(), 0)
            results[scene.name] = [*scene.checks(trajectory), overflow]
    return {scene.name: results[scene.name] for scene in scenes()}


def worst(checks: Sequence[Check]) -> Check:
    """The check that a row of the table shows: one that fails, or that comes closest to it."""

    def order(check: Check) -> tuple[bool, float]:
        room = check.value / check.limit if check.limit > 0 else float(check.value > check.limit)
        return (not check.holds, room)

    return max(checks, key=order)


def table(presets: Sequence[str]) -> str:
    """Markdown: a row a scene, a column a preset; each cell has the figure nearest to its limit (or beyond it)."""
    columns = {name: outcomes(PRESETS[name]) for name in presets}
    rows = [["scene", "figure, at most", *presets], ["---"] * (2 + len(presets))]
    for scene in scenes():
        shown = [worst(columns[name][scene.name]) for name in presets]
        cells = [f"{'' if c.holds else '**fails** '}{_figure_if_other(c, shown[0])}{c.value:.2g}" for c in shown]
        rows.append([scene.name, f"{shown[0].figure}: {shown[0].limit:g}", *cells])
    rows.append(["fails", "", *(str(sum(not all(c.holds for c in x) for x in columns[n].values())) for n in presets)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _figure_if_other(check: Check, first: Check) -> str:
    return "" if check.figure == first.figure else f"{check.figure}: "


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
