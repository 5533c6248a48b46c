"""Promises of the engine (tests/engine/promises/): invariances, virtual work, passivity and scenes with a closed form.

    python bench/engine_promises.py                                        # kernel, preset standard, all of them
    python bench/engine_promises.py --preset fine --only "virtual work" chain
    python bench/engine_promises.py --backend xla --only frame

A line a scene: pass or FAIL, figure, limit, unit, name, seconds. Exit code 1 where one fails. A scene whose data is
absent is named and left out.
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # run as a script where the project is not installed

from bench.program import exit_code, parser_of
from kinetix_dist.errors import UserError
from tests.engine.promises.families import all_promises
from tests.engine.promises.promise import PRESETS, Promise, Solver


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--backend", choices=("warp", "xla"), default="warp", help="default: warp")
    parser.add_argument("--preset", choices=PRESETS, default="standard", help="default: standard")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="only scenes whose names contain one of these")
    options = parser.parse_args(arguments)
    solver = Solver(options.preset, options.backend)
    return exit_code(parser, lambda: run(solver, options.only))


def run(solver: Solver, only: list[str] | None) -> int:
    """Prints each figure; 1 where one is beyond its limit. Raises UserError where `only` names nothing."""
    chosen = [promise for promise in all_promises() if only is None or any(text in promise.name for text in only)]
    if not chosen:
        raise UserError(f"no scene has {' or '.join(map(repr, only or []))} in its name; leave out --only to see all")
    kept = [holds for promise in chosen if (holds := report(promise, solver)) is not None]
    print(f"{sum(kept)} of {len(kept)} pass, preset {solver.preset}, backend {solver.backend}")
    return 0 if all(kept) else 1


def report(promise: Promise, solver: Solver) -> bool | None:
    """Prints a promise's line; whether it holds, None where its data is absent."""
    if promise.data is not None and not promise.data.exists():
        print(f"absent  {promise.name}: {promise.data} not found")
        return None
    started = time.perf_counter()
    value, limit = promise.measure(solver), promise.limits[solver.preset]
    holds = value <= limit and math.isfinite(value)
    seconds = time.perf_counter() - started
    verdict = "pass" if holds else "FAIL"
    print(f"{verdict}  {value:10.3g}  <= {limit:<8g} {promise.unit:22s} {promise.name}  ({seconds:.0f} s)", flush=True)
    return holds


if __name__ == "__main__":
    sys.exit(main())
