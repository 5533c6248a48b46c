"""Slots in random order, so that a slot number tells a policy nothing about what is in it."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.level.draft import Draft
from kinetix_dist.level.level import NUM_WALLS


def permute_slots(key: Array, draft: Draft, num_polygons: int) -> Draft:
    """The same draft with polygons (walls excepted), circles, joints and thrusters in other slots each.

    `body` and `added_at` move along but keep their values: they are the generator's notes, not slot numbers.
    """
    num_shapes = draft.shapes.active.shape[0]
    keys = jax.random.split(key, 4)
    walls = jnp.arange(NUM_WALLS)
    polygons = NUM_WALLS + jax.random.permutation(keys[0], num_polygons - NUM_WALLS)
    circles = num_polygons + jax.random.permutation(keys[1], num_shapes - num_polygons)
    source = jnp.concatenate([walls, polygons, circles])  # new slot -> old slot
    slot_of = jnp.argsort(source).astype(jnp.int32)  # old slot -> new slot
    joint_order = jax.random.permutation(keys[2], draft.joints.active.shape[0])
    thruster_order = jax.random.permutation(keys[3], draft.thrusters.active.shape[0])
    shapes = jax.tree.map(lambda x: x[source], draft.shapes)
    joints = jax.tree.map(lambda x: x[joint_order], draft.joints)
    thrusters = jax.tree.map(lambda x: x[thruster_order], draft.thrusters)
    return Draft(
        shapes=shapes,
        joints=dataclasses.replace(joints, a=slot_of[joints.a], b=slot_of[joints.b]),
        thrusters=dataclasses.replace(thrusters, body=slot_of[thrusters.body]),
    )
