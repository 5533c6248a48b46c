"""Sets of variants: which there are, and which level a variant was made of. No jax: results are also read later."""

from __future__ import annotations

from collections.abc import Sequence

# By name, the designed set whose levels they are variants of.
VARIED_SETS = {f"dev_designed_{size}": f"all_designed_{size}" for size in ("s", "m", "l")}


def variant_name(level: str, number: int) -> str:
    """The name of a variant of a level."""
    return f"{level}_{number}"


def base_levels(name: str, names: Sequence[str]) -> list[str]:
    """Of each level of set `name`, by the names in it: the level that it is a variant of, or itself.

    Variants of one level are solved or not together: they are one observation of levels like these.
    """
    return [each.rpartition("_")[0] for each in names] if name in VARIED_SETS else list(names)
