"""Shapes of parameters that are traced once and then read from the compile cache.

A checkpoint is restored into a tree of shapes. To get them from a network it is traced, which takes half a second of
Python in every process that resumes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from kinetix_dist.telemetry.cached_files import cached
from kinetix_dist.telemetry.exported_program import current_settings, sources_and_versions

KIND = "shapes"  # folder in the compile cache


def kept_shapes(made_from: object, make: Callable[[], Any]) -> Any:
    """What `make` gives, nested dictionaries of `jax.ShapeDtypeStruct`, from the compile cache where it is on and
    another process has written it there.

    made_from: all that the shapes depend on beside the sources of this project, the versions of JAX, numpy and
    Warp and JAX's settings; its repr is part of the key.
    """

    def content() -> bytes:
        made = make()
        rows = [(path, leaf.shape, leaf.dtype.name) for path, leaf in flatten_dict(made).items()]
        assert jax.tree.structure(_tree(rows)) == jax.tree.structure(made), "these are no nested dictionaries"
        return json.dumps(rows).encode()

    asked_for = repr((sources_and_versions(), current_settings(), made_from))
    return _tree(json.loads(cached(KIND, asked_for, content)))


def _tree(rows: Iterable[tuple[Sequence[str], Sequence[int], str]]) -> dict[str, Any]:
    return unflatten_dict(
        {tuple(path): jax.ShapeDtypeStruct(tuple(shape), np.dtype(dtype)) for path, shape, dtype in rows}
    )
