"""Colours and lengths of pictures of worlds, for all that draws: this rasteriser, the one on the device, rerun, pages.

`as_json()` gives them to what is written in other languages.
"""

from __future__ import annotations

import math
from typing import Any

Colour = tuple[int, int, int]

ROLE_PALETTE: tuple[Colour, ...] = (
    (176, 178, 186),  # no role
    (70, 178, 98),  # green
    (58, 118, 224),  # blue
    (224, 68, 64),  # red
)
MOTOR_PALETTE: tuple[Colour, ...] = ((240, 150, 40), (150, 90, 210), (30, 160, 170), (210, 80, 150))
THRUSTER_PALETTE: tuple[Colour, ...] = ((255, 140, 20), (200, 60, 200))
BACKGROUND: Colour = (250, 250, 248)
INK: Colour = (52, 54, 62)
HINGE: Colour = (255, 255, 255)
FLAME_CORE: Colour = (255, 236, 140)
FIXED_SHADE = 0.62  # fixed shapes are this much darker than movable ones of the same role
KINEMATIC_SHADE = 0.8  # and kinematic ones
OUTLINE_SHADE = 0.6

LINE_WIDTH = 1.6  # pixels, of outlines and of lines
WELD_WIDTH = 2.4
WELD_ANGLES = (0.25 * math.pi, 0.75 * math.pi)  # rad, of the two arms of the cross of a weld
BELT_ARROW_M = 0.1  # arrows along the outline of what has a surface speed, one every
BELT_SPACING_M = 0.4
THRUSTER_LENGTH_M = 0.16
NOZZLE_SHARE = 0.35  # half the width of a nozzle, of its length
FLAME_SHARE = 1.7  # length of a flame at full thrust, of the nozzle's
CORE_SHARE = 0.5  # of the bright core of a flame, of the flame
JOINT_RADIUS_M = 0.06
MOTOR_SHARE = 0.5  # radius of what says that a hinge has a motor, of JOINT_RADIUS_M
SLIDER_SHARE = 0.7  # of the block of a slider
SPRING_END_SHARE = 0.4  # of the ends of a spring
SPOKE_SHARE = 0.9  # length of the spoke of a disc, of its radius
RAIL_M = 0.5  # of a slider without limits, to each side
COIL_M = 0.05  # half the width of a spring
NUM_COILS = 6


def as_json() -> dict[str, Any]:
    """Returns all palettes by name in lower case, as JSON types; colours are [r, g, b] 0..255."""
    values = {name.lower(): value for name, value in globals().items() if name.isupper()}
    return {name: _listed(value) for name, value in values.items()}


def _listed(value: Any) -> Any:
    return [_listed(item) for item in value] if isinstance(value, tuple) else value
