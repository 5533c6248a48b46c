"""Clocks of the benchmarks."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def compute_clock(device: Any) -> Callable[[], float]:
    """Seconds of a launch on `device`: wall time on a GPU, the time of this process's processor on a CPU.

    A launch uses one core there, so processor time is what it would take with that core to itself: other jobs change
    it less.
    """
    return time.perf_counter if device.platform == "gpu" else time.process_time


def median_seconds(function: Callable[[], Any], repeats: int) -> float:
    """Median wall time of `repeats` calls, after one that is not counted (it may compile)."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)
