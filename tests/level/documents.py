"""A small valid level document that tests break in one place each."""

from __future__ import annotations

from typing import Any


def cart_document() -> dict[str, Any]:
    """Size M: a chassis on one driven wheel, a triangle, a goal and a thruster."""
    return {
        "format": "kinetix-dist-level",
        "version": 1,
        "name": "cart",
        "size": "m",
        "shapes": [
            {"id": "chassis", "type": "box", "width": 1.0, "height": 0.2, "position": [1.0, 1.0], "role": "green"},
            {
                "id": "wedge",
                "type": "polygon",
                "vertices": [[0.0, 0.0], [0.6, 0.0], [0.0, 0.3]],
                "position": [3.0, 0.4],
                "angle": 0.5,
                "density": 2.0,
            },
            {"id": "wheel", "type": "circle", "radius": 0.2, "position": [0.6, 0.9]},
            {"id": "goal", "type": "circle", "radius": 0.3, "position": [4.5, 0.7], "role": "blue", "fixed": True},
        ],
        "joints": [
            {
                "type": "revolute",
                "a": "chassis",
                "b": "wheel",
                "anchor": [0.6, 0.9],
                "motor": {"speed": 2.0, "power": 1.5, "colour": 3},
            }
        ],
        "thrusters": [{"shape": "wedge", "anchor": [3.0, 0.4], "angle": 1.0, "power": 0.5, "colour": 1}],
    }
