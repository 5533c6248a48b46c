"""Rest angles of joints between shapes whose angles were reduced (`jax2d.builder_checks.reduced`)."""

from __future__ import annotations

from jax2d.builder_checks import reduced


def reduced_rest_angle(rest_angle: float, shift: float, *, counts_turns: bool) -> float:
    """Return the rest angle (rad) that keeps angle_b - angle_a - rest_angle of a joint.

    Args:
        shift: the change of angle_b - angle_a, rad.
        counts_turns: the joint has limits, which may depend on the number of turns: none is dropped.
    """
    moved = rest_angle + shift
    return moved if counts_turns else reduced(moved)
