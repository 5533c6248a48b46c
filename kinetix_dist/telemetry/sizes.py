"""Size of arrays."""

from __future__ import annotations

from typing import Any


def bytes_of(tree: Any) -> int:
    """Bytes of all arrays in nested containers."""
    import jax

    return sum(getattr(leaf, "nbytes", 0) for leaf in jax.tree.leaves(tree))
