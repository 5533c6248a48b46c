"""Worlds drawn by the page against worlds drawn by the engine: one display list, two programs that paint it."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jax2d.display_list import display_list
from jax2d.palette import as_json
from jax2d.rasteriser import DEFAULT_VIEW, rasterise
from kinetix_dist.level.sets import load_level_set
from tests.studio.serving import Server

PIXELS = 524  # 100 a metre of the 5.24 m that are seen
DRAW = """async ([display, poses, thrust, palette, pixels]) => {
  const { drawWorld } = await moduleOf("world/canvas.js");
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = pixels;
  drawWorld(canvas, display, poses, palette, { thrust });
  return canvas.toDataURL("image/png").split(",")[1];
}"""


@pytest.fixture(scope="module")
def levels() -> Any:
    return [(name, size, level) for size in "sml" for name, level in _levels(size)]


def _levels(size: str) -> list[tuple[str, Any]]:
    import jax

    levels, names = load_level_set(f"designed_{size}", size)
    return [(name, jax.tree.map(lambda x, k=k: np.asarray(x)[k], levels)) for k, name in enumerate(names)]


@pytest.mark.long
def test_pages_and_engine_paint_the_same(levels: Any, trained_server: Server, open_page: Callable[..., Any]) -> None:
    """Mean difference below 2 of 255: they differ in how edges are smoothed."""
    page = open_page(trained_server)
    worst = 0.0
    for name, size, level in levels:
        roles = np.asarray(level.shape_role)
        display = display_list(
            level.scene, roles, motor_colours=level.motor_colour, thruster_colours=level.thruster_colour
        )
        thrust = np.full(level.scene.thrusters.active.shape, 0.7)
        position, angle = np.asarray(level.position), np.asarray(level.angle)
        expected = rasterise(display, position, angle, thrust=thrust, view=DEFAULT_VIEW)
        poses = np.concatenate([position, angle[:, None]], 1).ravel().tolist()
        content = page.evaluate(DRAW, [display.to_json(), poses, thrust.tolist(), as_json(), PIXELS])
        drawn = np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB"))
        assert drawn.shape == expected.shape
        difference = np.abs(drawn.astype(float) - expected.astype(float)).mean()
        assert difference < 2.0, f"{size}/{name}: {difference:.2f}"
        assert np.ptp(drawn.reshape(-1, 3), axis=0).max() > 100, "more than a background"
        worst = max(worst, difference)
    assert worst > 0, "two programs that agree to the bit would be one"
