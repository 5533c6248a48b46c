"""What a client is told at the start: what it can ask for, and the colours and lengths of pictures."""

from __future__ import annotations

from typing import Any

from jax2d import palette
from kinetix_dist.checkpoint.pretrained import pretrained_names
from kinetix_dist.level.generator_config import GENERATORS
from kinetix_dist.level.level import NUM_WALLS, SIZES
from kinetix_dist.level.mutators import MUTATORS
from kinetix_dist.level.walls import WALL_CENTRES_M, WALL_HALF_EXTENTS_M, WALL_NAMES


def hello() -> dict[str, Any]:
    """Sizes count what a level may have besides its walls; walls: m."""
    kinds = ("polygons", "circles", "joints", "thrusters")
    sizes = {name: {kind: getattr(capacity, kind) for kind in kinds} for name, capacity in SIZES.items()}
    for counts in sizes.values():
        counts["polygons"] -= NUM_WALLS
    walls = zip(WALL_NAMES, WALL_CENTRES_M.tolist(), WALL_HALF_EXTENTS_M.tolist(), strict=True)
    return {
        "walls": [{"name": name, "position": at, "half_extents": half} for name, at, half in walls],
        "palette": palette.as_json(),
        "sizes": sizes,
        "generators": list(GENERATORS),
        "mutators": list(MUTATORS),
        "pretrained": pretrained_names(),
    }
