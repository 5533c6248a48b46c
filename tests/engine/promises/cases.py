"""Promises as cases of pytest: one that the engine breaks is expected to fail, and reported once it no longer does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import pytest

from tests.engine.promises.promise import PRESETS, Promise, Solver


class Broken(NamedTuple):
    """Promises that the engine breaks."""

    start_of_name: str
    presets: tuple[str, ...]
    reason: str

    def names(self, promise: Promise) -> bool:
        return promise.name.startswith(self.start_of_name)


def cases(promises: Sequence[Promise], broken: Sequence[Broken], *, reference: bool = True) -> list[Any]:
    """(promise, preset, backend) for the kernel with every preset and the reference with `standard`, which takes a
    minute or two to compile for each capacity."""
    if unknown := [entry for entry in broken if not any(map(entry.names, promises))]:
        raise ValueError(f"no promise begins with {unknown[0].start_of_name!r}")
    solvers = [Solver(name) for name in PRESETS]
    if reference:
        solvers.append(Solver("standard", "xla"))
    return [_case(promise, solver, broken) for solver in solvers for promise in promises]


def assert_kept(promise: Promise, preset: str, backend: str) -> None:
    """Skips where the data of the promise is absent."""
    if promise.data is not None and not promise.data.exists():
        pytest.skip(f"{promise.data.name} not found beside the checkout")
    value, limit = promise.measure(Solver(preset, backend)), promise.limits[preset]
    assert math.isfinite(value) and value <= limit, f"{value:.3g} {promise.unit}"


def _case(promise: Promise, solver: Solver, broken: Sequence[Broken]) -> Any:
    marks: list[Any] = [pytest.mark.slow] if solver.backend == "xla" else []
    reasons = [entry.reason for entry in broken if entry.names(promise) and solver.preset in entry.presets]
    if len(reasons) > 1:
        raise ValueError(f"{promise.name!r} with {solver.preset} is in two entries")
    marks += [pytest.mark.xfail(strict=True, reason=reason) for reason in reasons]
    name, backend = solver.preset, solver.backend
    return pytest.param(promise, name, backend, id=f"{promise.name}-{name}-{backend}", marks=marks)
