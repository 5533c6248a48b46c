"""Learnability p (1 - p) of levels from counts of their episodes. numpy alone.

s solved of f episodes of one level give two estimates:

    plug-in    s (f - s) / f^2           what curricula rank levels by. Its mean is (1 - 1/f) p (1 - p) over all levels,
                                         and more than p (1 - p) over those that were chosen for it
    unbiased   s (f - s) / (f (f - 1))   share of the pairs of episodes that differ, halved: its mean is p (1 - p) where
                                         f says nothing of the outcomes, and where f is as many as ended in one world
                                         within some steps, if two always do
"""

from __future__ import annotations

import numpy as np


def plug_in_learnability(solved: np.ndarray, finished: np.ndarray) -> np.ndarray:
    """[n] of counts [n]; 0 for a level that finished no episode, as the curator has it."""
    p = solved / np.maximum(finished, 1)
    return p * (1 - p)


def unbiased_learnability(solved: np.ndarray, finished: np.ndarray) -> np.ndarray:
    """[n] of counts [n]; nan for a level with fewer than two."""
    pairs = finished * (finished - 1)
    return np.divide(solved * (finished - solved), pairs, out=np.full(len(solved), np.nan), where=pairs > 0)


def mean_and_error(values: np.ndarray) -> tuple[float | None, float | None]:
    """(mean, standard error) over independent levels, of what is finite; None where there is too little for it."""
    finite = values[np.isfinite(values)]
    mean = float(finite.mean()) if len(finite) else None
    return mean, float(finite.std(ddof=1) / np.sqrt(len(finite))) if len(finite) > 1 else None
