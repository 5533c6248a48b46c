"""Boxes hung on one another: links of legs and ropes."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax.numpy as jnp

from jax2d.fields import Array
from kinetix_dist.level.mechanisms.template import OPEN, Draws, Joint, Part, given


@dataclasses.dataclass(frozen=True, kw_only=True)
class Body:
    """Parts and joints of a mechanism that is being built."""

    parts: list[Part]
    joints: list[Joint] = dataclasses.field(default_factory=list)

    @property
    def last(self) -> int:
        """Index of the last part."""
        return len(self.parts) - 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Link:
    """A box that hangs by its upper end."""

    half: Array  # [2] m, half extents
    active: Array
    lean: Array | None = None  # rad, None: drawn
    motion: Literal["motor", "free", "welded"] = "motor"
    bend: Array | float = 0.0  # middle of the limits of a motor, from -1 to 1 times their half width
    is_stiff: Array | bool = False  # welded instead of driven


def add_link(draws: Draws, body: Body, link: Link, *, of: int, at: Array) -> Array:
    """Hangs a link at a point ([2] m) of part `of`. Returns the place of its other end."""
    angle = draws.between(-0.45, 0.45) if link.lean is None else link.lean
    down = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
    inside = 0.85 * link.half[1]
    body.parts.append(Part(position=at + inside * down, angle=angle, half=link.half, active=link.active))
    has_motor = link.motion == "motor"
    limit = draws.between(0.5, 1.2) if has_motor else None
    body.joints.append(
        Joint(
            a=of,
            b=body.last,
            at=at,
            limit=OPEN if limit is None else given(limit),
            bend=0.0 if limit is None else link.bend * limit,
            has_motor=has_motor,
            is_weld=link.is_stiff if has_motor else link.motion == "welded",
            active=link.active,
        )
    )
    return at + 2.0 * inside * down
