"""Which effects engines are compiled for, chosen from what a sample of levels calls for.

A level is cheapest on an engine that has its effects and no more, but each engine is a kernel to compile. So there are
a few: the full one, so that no level is ever refused, and those that save most over the sample.
"""

from __future__ import annotations

import itertools

import numpy as np

from jax2d.effects import EFFECTS, SLOTS, Effects, EffectTable
from jax2d.scene import Array, Capacity, index_worlds

MAX_VARIANTS = 4  # kernels of a few seconds of compilation each
MIN_SAVING = 0.02  # of the mean cost of a level: less is not worth a kernel
_MAX_PATTERNS = 8  # sets of effects that are combined to candidates, the most frequent ones
_CONTACT_QUANTILES = (0.25, 0.5, 0.75, 1.0)  # of the levels that share a set of effects

# What an engine keeps of each thing in the local memory of a thread, in numbers of 4 bytes (see jax2d/warp/native).
_NUMBERS_OF = {"polygon_slots": 38, "circle_slots": 22, "joint_slots": 25, "thruster_slots": 6, "contact_slots": 19}
_NUMBERS_OF_AN_EFFECT = 10  # registers and branches of its code, in the same unit


def choose_variants(
    sample: EffectTable, capacity: Capacity, *, max_variants: int = MAX_VARIANTS
) -> tuple[Effects, ...]:
    """At most `max_variants` of them, cheapest first; the last is `Effects.full(capacity)`.

    sample: `called_for` of the scenes of some levels, [W, ...] on every field, concrete.
    """
    if max_variants < 1:
        raise ValueError(f"max_variants is {max_variants}; at least 1 is needed, for the full engine")
    full = Effects.full(capacity)
    sample = EffectTable(flags=np.asarray(sample.flags), slots=np.asarray(sample.slots))
    candidates = _candidates(sample)
    costs = np.array([local_numbers(effects) for effects in candidates], float)
    covered = np.stack([_covers(effects, sample) for effects in candidates])  # [candidates, W]
    lowest = np.full(covered.shape[1], local_numbers(full), float)  # [W], of each level with the variants chosen so far
    chosen: list[int] = []
    for _ in range(max_variants - 1):
        saved = np.where(covered, np.maximum(lowest - costs[:, None], 0.0), 0.0).mean(axis=1)
        best = int(np.argmax(saved))
        if saved[best] < MIN_SAVING * lowest.mean():
            break
        chosen.append(best)
        lowest = np.where(covered[best], np.minimum(lowest, costs[best]), lowest)
    return (*(candidates[i] for i in sorted(chosen, key=lambda i: costs[i])), full)


def local_numbers(effects: Effects) -> int:
    """How much an engine holds for a world, about. It decides how many worlds a GPU runs at once."""
    slots = sum(number * getattr(effects, name) for name, number in _NUMBERS_OF.items())
    return slots + _NUMBERS_OF_AN_EFFECT * sum(getattr(effects, name) for name in EFFECTS)


def _candidates(sample: EffectTable) -> list[Effects]:
    """Unions of sets of effects that occur, each with room for the contacts of one, two, three or all quarters of its
    levels."""
    patterns, frequency = np.unique(sample.flags, axis=0, return_counts=True)
    frequent = patterns[np.argsort(-frequency, kind="stable")[:_MAX_PATTERNS]]
    sets = {tuple(patterns.any(axis=0))}
    for size in range(1, len(frequent) + 1):
        sets |= {tuple(np.any(some, axis=0)) for some in itertools.combinations(frequent, size)}
    contacts = sample.slots[:, SLOTS.index("contact_slots")]
    candidates = set()
    for allowed in sets:
        has_these = ~(sample.flags & ~np.array(allowed)).any(axis=1)
        for most in np.quantile(contacts[has_these], _CONTACT_QUANTILES, method="higher"):
            candidates.add(index_worlds(sample, has_these & (contacts <= most)).union())
    return sorted(candidates, key=lambda effects: (local_numbers(effects), repr(effects)))


def _covers(effects: Effects, sample: EffectTable) -> Array:
    """[W] bool, as `Effects.covers_worlds`, in numpy: there are hundreds of candidates."""
    flags = np.array([getattr(effects, name) for name in EFFECTS])
    slots = np.array([getattr(effects, name) for name in SLOTS])
    return ~(sample.flags & ~flags).any(axis=1) & (sample.slots <= slots).all(axis=1)
