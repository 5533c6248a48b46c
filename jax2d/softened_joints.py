"""Joints that are solved softer than others: those that hold a light body between heavy ones.

Joints are solved one after another, once a sub-step, and start from the impulses of the sub-step before. Where a light
body lies between heavy ones, solving one of its joints undoes nearly all that solving the other has done. What is left
of such an error oscillates, and the speed that undoes gaps feeds it; only the share of an impulse that a soft
constraint lets go damps it (docs/engine_solver.md). With the frequency of other joints trees of welded parts in free
flight spin themselves up until the speed limits act.

Both backends take the rule from here: the reference reads it, the kernel gets a bit a joint.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import Array, JointKind, Scene


def is_softened(scene: Scene) -> jax.Array:
    """[..., J] bool, of scenes as `only_what_acts` leaves them.

    A body's share in a joint is what of the joint's movement it makes, 0 to 1: 1/2 between equal bodies, 1 beside one
    that is fixed. A weld is softened at a body whose shares, of mass or of inertia, come to more than
    `max_share_of_welds`: 1 in the middle of a beam of equal parts, 1.5 where it is welded to a wall. A hinge is
    softened at a body that has nearly all of the movement of two joints, or if its anchor is farther from a body's
    centre than `max_lever` radii of gyration, twice as far as any inside a convex shape. So is a weld where that body
    has several joints. Sliders are not softened and do not count: softened ones would let go of what hangs from them.
    All of their limits are softened instead."""
    shapes, joints = scene.shapes, scene.joints
    is_weld = joints.is_kind(JointKind.FIXED)[..., None]
    counts = joints.active & ~joints.is_kind(JointKind.PRISMATIC)
    ends = jnp.stack([jnp.asarray(joints.a), jnp.asarray(joints.b)], -1)  # [..., J, 2]
    arm = jnp.stack([_squared(joints.anchor_a), _squared(joints.anchor_b)], -1)
    mass, inertia = (_of(jnp.asarray(x), ends) for x in (shapes.inverse_mass, shapes.inverse_inertia))
    of_mass, of_inertia, of_point = _shares(mass), _shares(inertia), _shares(mass + inertia * arm)
    is_light = jnp.where(is_weld, jnp.maximum(of_mass, of_inertia), of_point) > C.light_share
    is_long = (mass > 0) & (inertia * arm > C.max_lever**2 * mass)

    at = (ends[..., None] == jnp.arange(shapes.inverse_mass.shape[-1])) & counts[..., None, None]  # [..., J, 2, n]
    by_mass, by_inertia, lights = (jnp.sum(at * x[..., None], axis=(-3, -2)) for x in (of_mass, of_inertia, is_light))
    of_weld, of_hinge = jnp.maximum(by_mass, by_inertia) > C.max_share_of_welds, lights >= 2
    held = jnp.where(is_weld, _of(of_weld, ends), _of(of_hinge, ends))
    has_several = _of(jnp.sum(at, axis=(-3, -2)) >= 2, ends)
    return counts & jnp.any(held | (is_long & (has_several | ~is_weld)), axis=-1)


def _shares(inverse: jax.Array) -> jax.Array:
    """Shares of both ends, [..., J, 2]."""
    whole = jnp.sum(inverse, axis=-1, keepdims=True)
    return inverse / jnp.where(whole > 0, whole, 1)


def _squared(anchor: Array) -> jax.Array:
    return jnp.sum(jnp.square(jnp.asarray(anchor)), axis=-1)


def _of(values: jax.Array, ends: jax.Array) -> jax.Array:
    """Returns values [..., n] at [..., J, 2]."""
    return jnp.take_along_axis(values[..., None, :], ends, axis=-1)
