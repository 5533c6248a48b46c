"""Which engines are compiled: few, the full one among them, and those that the sample has most use for."""

from __future__ import annotations

import numpy as np
import pytest

from jax2d.effects import EFFECTS, SLOTS, Effects, EffectTable
from kinetix_dist.env.effect_variants import choose_variants, local_numbers
from kinetix_dist.level.level import SIZES

CAPACITY = SIZES["s"]
FALLS = Effects(polygon_pairs=True, gravity=True, polygon_slots=5, contact_slots=10)
DRIVES = FALLS | Effects(revolute_joints=True, motors=True, joint_slots=1)
CROWDED = FALLS | Effects(contact_slots=20)
FULL = Effects.full(CAPACITY)


def sample(shares: dict[Effects, int]) -> EffectTable:
    """Levels that call for these effects, so many of each."""
    rows = [effects for effects, count in shares.items() for _ in range(count)]
    return EffectTable(
        flags=np.array([[getattr(row, name) for name in EFFECTS] for row in rows]),
        slots=np.array([[getattr(row, name) for name in SLOTS] for row in rows], np.int32),
    )


def test_each_frequent_set_of_effects_gets_an_engine_and_the_full_one_comes_last() -> None:
    assert choose_variants(sample({FALLS: 50, DRIVES: 50}), CAPACITY) == (FALLS, DRIVES, FULL)


def test_levels_with_fewer_contacts_get_an_engine_with_room_for_fewer() -> None:
    assert choose_variants(sample({FALLS: 50, CROWDED: 50}), CAPACITY) == (FALLS, CROWDED, FULL)


def test_what_few_levels_call_for_is_no_engine_of_its_own() -> None:
    assert choose_variants(sample({FALLS: 1, DRIVES: 999}), CAPACITY) == (DRIVES, FULL)


def test_levels_that_call_for_everything_get_the_full_engine_alone() -> None:
    assert choose_variants(sample({FULL: 10}), CAPACITY) == (FULL,)


@pytest.mark.parametrize("most", [1, 2, 3, 4])
def test_variants_are_bounded_and_in_the_order_of_their_cost(most: int) -> None:
    levels = {FALLS | Effects(contact_slots=slots): 10 for slots in (10, 13, 16, 19, 22, 25, 28)}
    variants = choose_variants(sample(levels), CAPACITY, max_variants=most)
    assert len(variants) == most
    assert variants[-1] == FULL
    assert [local_numbers(v) for v in variants] == sorted(local_numbers(v) for v in variants)


def test_no_variant_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="max_variants is 0"):
        choose_variants(sample({FALLS: 1}), CAPACITY, max_variants=0)
