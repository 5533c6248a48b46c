"""Drawn pictures (uint8 [height, width, 3]) side by side with captions, as PNG and as moving GIF files. By Pillow."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jax2d.palette import BACKGROUND, INK

GUTTER_PX = 8
CAPTION_PX = 26
FONT_PX = 16
GIF_TICK_S = 0.01  # a GIF's frames last whole hundredths of a second


def film_strip(images: Sequence[np.ndarray], captions: Sequence[str], *, columns: int | None = None) -> np.ndarray:
    """Lays pictures of one size out in rows of `columns` (default: one row), each below its caption.

    Returns uint8 [height, width, 3]; ValueError for no pictures, of several sizes, or other captions than pictures.
    """
    if not images or len(images) != len(captions):
        raise ValueError(f"{len(images)} pictures and {len(captions)} captions; give one caption a picture")
    if len({image.shape for image in images}) != 1:
        raise ValueError(f"pictures differ in shape: {[image.shape for image in images]}")
    columns = columns or len(images)
    height, width = images[0].shape[:2]
    rows = -(-len(images) // columns)
    cell_height, cell_width = height + CAPTION_PX + GUTTER_PX, width + GUTTER_PX
    strip = Image.new("RGB", (columns * cell_width + GUTTER_PX, rows * cell_height + GUTTER_PX), BACKGROUND)
    pen, font = ImageDraw.Draw(strip), ImageFont.load_default(FONT_PX)
    for k, (image, caption) in enumerate(zip(images, captions, strict=True)):
        left, top = GUTTER_PX + k % columns * cell_width, GUTTER_PX + k // columns * cell_height
        pen.text((left, top + CAPTION_PX / 2), caption, fill=INK, font=font, anchor="lm")
        strip.paste(_to_pillow(image), (left, top + CAPTION_PX))
    return np.array(strip)


def write_png(path: str | os.PathLike[str], image: np.ndarray) -> None:
    """Writes a picture as PNG. Raises ValueError for another array and OSError where it cannot be written."""
    _to_pillow(image).save(path, "PNG")


def write_gif(path: str | os.PathLike[str], images: Sequence[np.ndarray], *, seconds: Sequence[float]) -> None:
    """Writes pictures of one size as a GIF that repeats for ever; `seconds` says how long each is shown.

    Rounding to hundredths of a second does not add up: picture k begins within 5 ms of the sum of those before it.
    """
    if not images or len(images) != len(seconds):
        raise ValueError(f"{len(images)} pictures and {len(seconds)} durations; give one duration a picture")
    ends = np.rint(np.cumsum(seconds) / GIF_TICK_S)
    durations_ms = np.diff(ends, prepend=0.0) * (1000 * GIF_TICK_S)
    frames = [
        _to_pillow(image).quantize(method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE) for image in images
    ]
    frames[0].save(
        path, "GIF", save_all=True, append_images=frames[1:], duration=durations_ms.tolist(), loop=0, optimize=True
    )


def _to_pillow(image: np.ndarray) -> Image.Image:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"a picture is uint8 [height, width, 3]; got {image.dtype} {list(image.shape)}")
    return Image.fromarray(image)
