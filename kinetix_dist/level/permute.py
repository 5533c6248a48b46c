"""Slots in random order, so that a slot number tells a policy nothing about what is in it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array, replace
from kinetix_dist.level.draft import Draft, row_at
from kinetix_dist.level.level import NUM_WALLS


def permute_slots(draw: Array, draft: Draft, num_polygons: int) -> Draft:
    """The same draft with polygons (walls excepted), circles, joints and thrusters in other slots each.

    `draw` holds `num_permutation_draws(draft)` uniform numbers. `body` and `added_at` move along but keep their
    values: they are the generator's notes, not slot numbers.
    """
    num_shapes = draft.shapes.active.shape[0]
    num_joints, num_thrusters = draft.joints.active.shape[0], draft.thrusters.active.shape[0]
    ends = np.cumsum([num_polygons - NUM_WALLS, num_shapes - num_polygons, num_joints, num_thrusters])
    by_draw = [jnp.argsort(part) for part in jnp.split(draw, ends[:-1])]
    walls = jnp.arange(NUM_WALLS)
    polygons = NUM_WALLS + by_draw[0]
    circles = num_polygons + by_draw[1]
    source = jnp.concatenate([walls, polygons, circles])  # new slot -> old slot
    slot_of = jnp.argsort(source).astype(jnp.int32)  # old slot -> new slot
    joint_order = by_draw[2]
    thruster_order = by_draw[3]
    shapes = jax.tree.map(lambda x: row_at(x, source), draft.shapes)
    joints = jax.tree.map(lambda x: row_at(x, joint_order), draft.driven_joints)
    thrusters = jax.tree.map(lambda x: row_at(x, thruster_order), draft.driven_thrusters)
    return Draft(
        shapes=shapes,
        driven_joints=replace(
            joints, joints={"a": row_at(slot_of, joints.joints.a), "b": row_at(slot_of, joints.joints.b)}
        ),
        driven_thrusters=replace(thrusters, thrusters={"body": row_at(slot_of, thrusters.thrusters.body)}),
    )


def num_permutation_draws(draft: Draft) -> int:
    """How many uniform numbers `permute_slots` wants."""
    counts = (draft.shapes.active, draft.joints.active, draft.thrusters.active)
    return sum(active.shape[0] for active in counts) - NUM_WALLS
