"""Zero crossings and extrema of sampled quantities, interpolated: what lies between two steps is no engine's error."""

from __future__ import annotations

import itertools

import numpy as np


def zero_crossings(values: np.ndarray, interval: float) -> np.ndarray:
    """Times at which a quantity changes sign, s from its first sample. A value of zero counts with what follows."""
    signs = np.sign(values)
    for k in range(len(signs) - 2, -1, -1):
        signs[k] = signs[k] or signs[k + 1]
    at = np.flatnonzero(signs[1:] * signs[:-1] < 0)
    before, after = values[at], values[at + 1]
    return interval * (at + before / (before - after))


def vertex(values: np.ndarray, k: int) -> float:
    """Extreme of the parabola through samples k - 1, k, k + 1; at an end the sample itself."""
    if k in (0, len(values) - 1):
        return float(values[k])
    before, here, after = values[k - 1 : k + 2]
    bend = after - 2 * here + before
    return float(here if bend == 0 else here - (after - before) ** 2 / (8 * bend))


def peak(values: np.ndarray) -> float:
    """The largest value, between samples."""
    return vertex(values, int(np.argmax(values)))


def bounce_heights(height: np.ndarray, upward_speed: np.ndarray) -> list[float]:
    """Highest point after each bounce (falling turns into rising); of the last flight only if it came down again."""
    rising = upward_speed > 0
    bounces = [*np.flatnonzero(~rising[:-1] & rising[1:]), len(height) - 1]
    heights = []
    for start, end in itertools.pairwise(bounces):
        top = start + int(np.argmax(height[start : end + 1]))
        if top < len(height) - 1:
            heights.append(vertex(height, top))
    return heights
