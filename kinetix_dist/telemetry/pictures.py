"""A rollout as one picture, moments from start to end side by side, or as a moving one; with paths of green and blue.

Made by jax2d's own rasteriser: no display, no GPU, no system package.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from jax2d.draw import draw
from jax2d.images import film_strip, write_gif, write_png
from kinetix_dist.telemetry.recording import Rollout

DEFAULT_MOMENTS = 5
GIF_FRAME_S = 1 / 15
GIF_LAST_FRAME_S = 1.0  # the outcome stays to be seen
GRID_WIDTH_PX = 1200.0
LEVEL_WIDTH_M = 5.3


def rollout_picture(
    rollout: Rollout, *, num_moments: int = DEFAULT_MOMENTS, pixels_per_metre: float = 60.0, columns: int | None = None
) -> np.ndarray:
    """uint8 [height, width, 3]. The first moment is the start, the last the end; a short rollout has fewer."""
    if num_moments < 1:
        raise ValueError(f"num_moments is {num_moments}; a picture shows at least 1")
    moments = np.unique(np.rint(np.linspace(0, rollout.num_steps, num_moments)).astype(int))
    images = [moment_picture(rollout, int(k), pixels_per_metre=pixels_per_metre) for k in moments]
    captions = [f"{rollout.seconds[k]:.2f} s" for k in moments]
    return film_strip(images, captions, columns=columns)


def moment_picture(rollout: Rollout, state: int, *, pixels_per_metre: float = 100.0) -> np.ndarray:
    """One state of a rollout, uint8 [height, width, 3]: flames of the step that led there, paths up to there."""
    scene, roles = rollout.level.scene, np.asarray(rollout.level.shape_role)
    moving = np.asarray(scene.shapes.active) & (np.asarray(scene.shapes.inverse_mass) > 0)
    followed = np.flatnonzero(moving & (roles > 0))
    return draw(
        scene,
        SimpleNamespace(position=rollout.position[state], angle=rollout.angle[state]),
        roles,
        thrust=rollout.thruster[state - 1] if state > 0 else None,
        trails=[rollout.position[: state + 1, i] for i in followed],
        pixels_per_metre=pixels_per_metre,
    )


def write_rollout_picture(
    path: str | os.PathLike[str], rollout: Rollout, *, num_moments: int = DEFAULT_MOMENTS
) -> None:
    """Writes `rollout_picture` as a PNG file."""
    write_png(path, rollout_picture(rollout, num_moments=num_moments))


def write_rollout_gif(path: str | os.PathLike[str], rollout: Rollout, *, pixels_per_metre: float = 60.0) -> None:
    """Writes the rollout as a GIF in real time, about 15 pictures a second."""
    moments, seconds = _gif_moments(rollout)
    images = [moment_picture(rollout, int(k), pixels_per_metre=pixels_per_metre) for k in moments]
    write_gif(path, images, seconds=seconds)


def grid_scale(columns: int, *, of_one: float) -> float:
    """Pixels per metre of a grid that is not wider than `GRID_WIDTH_PX`; `of_one`: at most so many."""
    return min(of_one, GRID_WIDTH_PX / (columns * LEVEL_WIDTH_M))


def grid_picture(rollouts: Sequence[Rollout], state: int, *, pixels_per_metre: float, columns: int) -> np.ndarray:
    """The same moment of several rollouts in a grid below their names; one that is over stays at its end."""
    moments = [
        moment_picture(rollout, min(state, rollout.num_steps), pixels_per_metre=pixels_per_metre)
        for rollout in rollouts
    ]
    return film_strip(moments, [rollout.level_name for rollout in rollouts], columns=columns)


def write_grid_gif(
    path: str | os.PathLike[str], rollouts: Sequence[Rollout], *, pixels_per_metre: float, columns: int
) -> None:
    """Writes several rollouts side by side as a GIF, as `write_rollout_gif` does one. All have steps of one length."""
    longest = max(rollouts, key=lambda rollout: rollout.num_steps)
    moments, seconds = _gif_moments(longest)
    images = [grid_picture(rollouts, int(k), pixels_per_metre=pixels_per_metre, columns=columns) for k in moments]
    write_gif(path, images, seconds=seconds)


def _gif_moments(rollout: Rollout) -> tuple[np.ndarray, list[float]]:
    """States to show, and for how many seconds each."""
    every = max(1, round(GIF_FRAME_S / rollout.step_seconds))
    moments = np.unique([*range(0, rollout.num_steps, every), rollout.num_steps])
    return moments, [*np.diff(rollout.seconds[moments]), GIF_LAST_FRAME_S]
