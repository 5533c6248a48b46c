"""How large arrays are."""

from __future__ import annotations

from typing import Any


def bytes_of(tree: Any) -> int:
    """Of all arrays in nested containers."""
    import jax

    return sum(getattr(leaf, "nbytes", 0) for leaf in jax.tree.leaves(tree))
