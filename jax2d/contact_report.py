"""Report of contacts in a physics step: where, how hard, between which shapes. `Engine(report_contacts=True)` gives
it."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.constants import CONSTANTS as C
from jax2d.fields import Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactReport:
    """Contacts of the last physics step of a call, of one world; [W, ...] of a batch. K is `Capacity.contact_slots`.

    A slot in use is one point of two shapes that touch or are about to. Slots in use come first; the others have -1 for
    a and b, and zeros. Points, normals and separations are those at the end of the step. Impulses are sums over the
    step, of all its sub-steps and of bounces: those of all slots add up to the momentum that contacts gave each body. A
    contact that ended within the step keeps its slot, as it was last. The mean force of the step is impulse / dt.
    """

    count: Array  # [] int32, slots in use
    a: Array  # [K] int32 shape index, lower than b
    b: Array  # [K] int32
    point: Array  # [K, 2] m, world frame, midway between the two surfaces
    normal: Array  # [K, 2] from a to b
    separation: Array  # [K] m, below zero where they overlap
    impulse: Array  # [K, 2] N s on b, world frame; on a it is the opposite
    dropped: Array  # [] int32, contacts of the step that found no slot here: their impulses are missing

    @property
    def normal_impulse(self) -> Array:
        """[K] N s that push the two apart. (Below zero only where the normal changed within the step.)"""
        return (self.impulse * self.normal).sum(-1)

    @property
    def tangent_impulse(self) -> Array:
        """[K] N s, friction on b, along the normal turned clockwise by 90 degrees."""
        return self.impulse[..., 0] * self.normal[..., 1] - self.impulse[..., 1] * self.normal[..., 0]

    def impulse_on(self, num_shapes: int) -> Array:
        """[n, 2] N s, what all contacts together gave each of `num_shapes` shapes."""
        shapes = np.arange(num_shapes)[:, None]
        is_a, is_b = ((x[..., None, :] == shapes).astype(self.impulse.dtype) for x in (self.a, self.b))
        return ((is_b - is_a)[..., None] * self.impulse[..., None, :, :]).sum(-2)


def contact_report(
    key: Array, *, point: Array, normal: Array, separation: Array, impulse: Array, dropped: Array
) -> ContactReport:
    """Report from the keys of contacts, [..., K], -1 where free."""
    in_use = key >= 0
    return ContactReport(
        count=jnp.sum(in_use, axis=-1, dtype=jnp.int32),
        a=jnp.where(in_use, key >> (C.feature_bits + C.shape_bits), -1),
        b=jnp.where(in_use, (key >> C.feature_bits) & ((1 << C.shape_bits) - 1), -1),
        point=point,
        normal=normal,
        separation=separation,
        impulse=impulse,
        dropped=dropped,
    )
