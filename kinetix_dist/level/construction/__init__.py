"""Building a level action by action: what a teacher that designs levels does (PAIRED, Dennis et al. 2020).

    steps 2k, 2k + 1    shape k is described (what, size, angle), then placed, or held by a joint to one that is there
    the last T steps    a thruster each, or none

Shape 0 is green and shape 1 blue; what follows is plain, or red once. An action is one choice of each head of HEADS;
`allowed` says which choices a step has: all others are masked, so that every sequence of allowed actions ends in a
valid level: what is placed overlaps nothing that it may collide with, joints hold shapes that exist, green and blue
are one each and not both fixed, and there is a motor or a thruster. A head without a meaning in a step has choice 0
alone. What does not fit anywhere is left out. Places and joints are those of a grid, as the mask has to know them; a
choice of size, angle, speed or power stands for a range, within which a uniform number decides.

Everything is for one level; `jax.vmap` gives a batch. Random numbers are handed in.
"""

from __future__ import annotations

from kinetix_dist.level.construction.actions import apply_action
from kinetix_dist.level.construction.masks import allowed
from kinetix_dist.level.construction.records import (
    HEADS,
    NUM_DRAWS,
    Construction,
    What,
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
    "Construction",
    "What",
    "allowed",
    "apply_action",
    "begin",
    "check_construction",
    "finish",
    "head_sizes",
    "num_order_draws",
    "num_steps",
]
