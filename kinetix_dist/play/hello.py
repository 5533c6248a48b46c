"""What a client is told at the start: what it can ask for, and the colours and lengths of pictures."""

from __future__ import annotations

from typing import Any

from jax2d import palette
from kinetix_dist.checkpoint.pretrained import pretrained_names
from kinetix_dist.level.generator_config import GENERATORS
from kinetix_dist.level.level import NUM_WALLS, SIZES
from kinetix_dist.level.mutators import MUTATORS


def hello() -> dict[str, Any]:
    """Sizes count what a level may have besides its walls."""
    kinds = ("polygons", "circles", "joints", "thrusters")
    sizes = {name: {kind: getattr(capacity, kind) for kind in kinds} for name, capacity in SIZES.items()}
    for counts in sizes.values():
        counts["polygons"] -= NUM_WALLS
    return {
        "palette": palette.as_json(),
        "sizes": sizes,
        "generators": list(GENERATORS),
        "mutators": list(MUTATORS),
        "pretrained": pretrained_names(),
    }
