"""Tables of a sweep: its plan from the design, what it found from sweep.json."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from kinetix_dist.sweep.arms import Run
    from kinetix_dist.sweep.design import Design
    from kinetix_dist.sweep.factorial import Factorial

WIDTH = 120  # columns of tables that go to a file


def console() -> Console:
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=WIDTH)


def arms_table(design: Design, runs: list[Run]) -> Any:
    from rich.table import Table

    table = Table(title=f"{design.name}: {len(runs)} runs of recipe {design.recipe}")
    table.add_column("arm")
    table.add_column("seeds")
    factors = design.factorial.factors if design.factorial is not None else ()
    for factor in factors:
        table.add_column(factor.name)
    if not factors:
        table.add_column("options")
    seeds: dict[str, list[str]] = {}
    for one in runs:
        seeds.setdefault(one.arm.name, []).append(str(one.seed))
    for arm in {one.arm.name: one.arm for one in runs}.values():
        cells = [_level(factor, arm.levels[factor.name]) for factor in factors]
        if not factors:
            own = next(entry.options for entry in design.arms if entry.name == arm.name)
            cells = [", ".join(f"{name} {value}" for name, value in own.items()) or "-"]
        table.add_row(arm.name, " ".join(seeds[arm.name]), *cells)
    return table


def _level(factor: Any, sign: int) -> str:
    return " ".join(str(value) for value in (factor.high if sign > 0 else factor.low).values())


def print_aliases(console: Console, factorial: Factorial) -> None:
    from kinetix_dist.sweep.factorial import two_level_design

    plan = two_level_design(factorial)
    numerals = {3: "III", 4: "IV", 5: "V"}
    if plan.resolution is None:
        console.print("full design: no main effect is aliased with an interaction", highlight=False)
        return
    console.print(f"resolution {numerals.get(plan.resolution, plan.resolution)}", highlight=False)
    for name, interactions in plan.aliases().items():
        text = " + ".join(interactions) if interactions else "no two-factor interaction"
        console.print(f"{name} is aliased with {text}", highlight=False, soft_wrap=True)


def scores_table(found: dict[str, Any]) -> Any:
    from rich.table import Table

    table = Table(title="Arms, mean over seeds (95 % interval)")
    table.add_column("arm")
    table.add_column("until s", justify="right")
    table.add_column("area", justify="right")
    table.add_column("last three", justify="right")
    for row in found["arms"]:
        table.add_row(row["arm"], f"{row['until']:g}", _interval(row["area"]), _interval(row["last"]))
    return table


def effects_table(effects: dict[str, Any]) -> Any:
    from rich.table import Table

    source, freedom = effects["area"][0]["error_from"], effects["area"][0]["degrees_of_freedom"]
    error = f"errors from {source}, {freedom} degrees of freedom" if source else "nothing says how large errors are"
    whole = "" if effects["is_whole"] else ", the fold-over is not complete"
    table = Table(title=f"Main effects of {effects['of']}, high less low (95 % interval): {error}{whole}")
    table.add_column("factor")
    table.add_column("area", justify="right")
    table.add_column("its error", justify="right")
    table.add_column("last three", justify="right")
    table.add_column("aliased with")
    for area, last in zip(effects["area"], effects["last"], strict=True):
        error = "-" if area["standard_error"] is None else f"{area['standard_error']:.4f}"
        aliases = " + ".join(effects["aliases"][area["name"]]) or "-"
        table.add_row(area["name"], _interval(area, "+"), error, _interval(last, "+"), aliases)
    return table


def _interval(estimate: dict[str, Any], sign: str = "") -> str:
    from kinetix_dist.evaluation.intervals import NO_SPREAD

    value = f"{estimate['value']:{sign}.4f}"
    if estimate["low"] is None:
        return value if estimate["standard_error"] is None else f"{value} ({NO_SPREAD})"
    return f"{value} ({estimate['low']:{sign}.4f} to {estimate['high']:{sign}.4f})"
