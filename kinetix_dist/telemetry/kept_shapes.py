"""Shapes of parameters that are traced once and then read from the compile cache.

A checkpoint is restored into a tree of shapes. To get them from a network it is traced, which takes half a second of
Python in every process that resumes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from kinetix_dist.telemetry.cached_files import cached
from kinetix_dist.telemetry.exported_program import current_settings, sources_and_versions

KIND = "shapes"  # folder in the compile cache


def kept_shapes(made_from: object, make: Callable[[], Any]) -> Any:
    """What `make` gives, nested dictionaries of `jax.ShapeDtypeStruct`, from the compile cache where it is on and
    another process has written it there.

    made_from: all that the shapes depend on beside the sources of this project, the versions of JAX and numpy and
    JAX's settings; its repr is part of the key.
    """

    def content() -> bytes:
        made = make()
        rows = [
            ([entry.key for entry in path], list(leaf.shape), leaf.dtype.name)
            for path, leaf in jax.tree_util.tree_leaves_with_path(made)
        ]
        assert jax.tree.structure(_nested(rows)) == jax.tree.structure(made), "these are no nested dictionaries"
        return json.dumps(rows).encode()

    asked_for = repr((sources_and_versions(), current_settings(), made_from))
    return _nested(json.loads(cached(KIND, asked_for, content)))


def _nested(rows: list[tuple[list[str], list[int], str]]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for (*path, name), shape, dtype in rows:
        inner = tree
        for key in path:
            inner = inner.setdefault(key, {})
        inner[name] = jax.ShapeDtypeStruct(tuple(shape), np.dtype(dtype))
    return tree
