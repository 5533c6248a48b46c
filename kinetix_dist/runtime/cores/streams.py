"""Random streams of a run. Everything random follows from (seed, stream, update, world): there is no generator state to
keep, and no result depends on how worlds are spread over devices.
"""

from __future__ import annotations

from jax2d.scene import Array
from kinetix_dist import prng

# Folded into the key of the seed, then whatever varies within a stream.
INIT, LEVELS, PLAY, SHUFFLE, CURATE, TEACHER, ANTAGONIST, PROBE, STARTS = range(9)


def stream(seed: int, number: int) -> Array:
    """A typed key; streams of one seed are independent."""
    return prng.fold_in(prng.key(seed), number)
