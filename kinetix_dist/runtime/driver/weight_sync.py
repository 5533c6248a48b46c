"""Versions of the policy on their way from the learner to those who act with it.

Weights are put into the object store once and passed on by reference. Rollout actors (lag 1) need the last two
versions; a curator keeps the reference that its refresh was asked for with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


class WeightStore:
    """Published versions by number. Holds whatever stands for weights: arrays or references to them."""

    def __init__(self, *, keep_last: int = 2) -> None:
        self._keep_last = keep_last
        self._weights: dict[int, Any] = {}

    def publish(self, version: int, weights: Any) -> None:
        """Adds a version and forgets those that are not recent."""
        self._weights[version] = weights
        recent = sorted(self._weights)[-self._keep_last :]
        self._weights = {v: w for v, w in self._weights.items() if v in recent}

    def __contains__(self, version: int) -> bool:
        return version in self._weights

    @property
    def newest(self) -> Any:
        return self._weights[max(self._weights)]

    def get(self, version: int) -> Any:
        if version not in self._weights:
            raise LookupError(f"policy version {version} is not kept; kept are {sorted(self._weights)}")
        return self._weights[version]


def resolve(weights: Any) -> Any:
    """Weights themselves, fetched first where they are a reference into the object store."""
    fetch = getattr(weights, "fetch", None)
    return fetch() if callable(fetch) else weights


def nested(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Nested dictionaries from names with slashes: parameters of a flax module."""
    tree: dict[str, Any] = {}
    for name, array in arrays.items():
        *path, last = name.split("/")
        node = tree
        for part in path:
            node = node.setdefault(part, {})
        node[last] = array
    return tree
