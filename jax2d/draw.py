"""A picture of a world in one call: its display list, rasterised.

image = draw(scene, state, roles=roles)          # uint8 [height, width, 3]
images.write_png("world.png", image)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np

from jax2d.display_list import ColourKeywords, display_list
from jax2d.rasteriser import DEFAULT_VIEW, Box, rasterise
from jax2d.scene import Scene


def draw(
    scene: Scene,
    state: Any,
    roles: Any = None,
    *,
    thrust: Any = None,
    view: Box = DEFAULT_VIEW,
    pixels_per_metre: float = 100.0,
    trails: Sequence[np.ndarray] = (),
    **colours: Unpack[ColourKeywords],
) -> np.ndarray:
    """Draws one world. Returns uint8 [height, width, 3].

    Args:
      scene: one world (no leading axis).
      state: anything with `position` [n, 2] and `angle` [n]: a State, or a level at its start.
      roles, colours: see `display_list`.
      thrust: [T] 0..1, how much each thruster fires; None draws no flames.
      view: the part of the world to show, m.
      trails: paths [k, 2] m to draw over the shapes, fading in (where something has been).
    """
    position, angle = np.asarray(state.position, float), np.asarray(state.angle, float)
    if position.ndim != 2:
        raise ValueError(f"draw shows one world; position has shape {position.shape}: select one with index_worlds")
    display = display_list(scene, roles, **colours)
    return rasterise(
        display, position, angle, thrust=thrust, view=view, pixels_per_metre=pixels_per_metre, trails=trails
    )
