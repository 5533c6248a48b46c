"""Levels built action by action, by a teacher that designs them (PAIRED, Dennis et al. 2020).

    steps 2k, 2k + 1    shape k is described (kind, size, angle), then placed, or joined to an existing shape
    the last T steps    a thruster each, or none

Shape 0 is green and shape 1 blue; later shapes are plain, or red once. An action is one choice of each head of HEADS.
`allowed` masks the choices of a step so that every sequence of allowed actions ends in a valid level: shapes overlap
nothing that they may collide with, joints hold shapes that exist, green and blue are one each and not both fixed, and
there is a motor or a thruster. A head without a meaning in a step has choice 0 alone. A shape that fits nowhere is left
out. Positions and joints are those of a grid, so that masks are finite; a choice of size, angle, speed or power is a
range, within which a uniform number decides.

Everything is for one level; `jax.vmap` gives a batch. Random numbers are arguments.
"""

from __future__ import annotations

from kinetix_dist.level.construction.actions import apply_action
from kinetix_dist.level.construction.allowed import allowed
from kinetix_dist.level.construction.records import (
    HEADS,
    NUM_DRAWS,
    Addition,
    Construction,
    begin,
    check_construction,
    finish,
    head_sizes,
    num_order_draws,
    num_steps,
)

__all__ = [
    "HEADS",
    "NUM_DRAWS",
    "Addition",
    "Construction",
    "allowed",
    "apply_action",
    "begin",
    "check_construction",
    "finish",
    "head_sizes",
    "num_order_draws",
    "num_steps",
]
