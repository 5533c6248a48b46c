"""Several moments side by side in one picture, each with its time written above it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jax2d.draw import BACKGROUND, INK

GUTTER_PX = 8
CAPTION_PX = 26
GLYPH_SCALE = 2  # a glyph is 3 x 5 dots; each is this many pixels square

# Five rows of three dots a glyph, as octal digits from the top: 5 is "# #", 7 is "###".
_GLYPHS = {
    "0": "75557", "1": "26227", "2": "71747", "3": "71717", "4": "55711", "5": "74717", "6": "74757", "7": "71111",
    "8": "75757", "9": "75717", ".": "00002", "-": "00700", "+": "02720", "s": "07427", " ": "00000",
}  # fmt: skip


def text_mask(text: str) -> np.ndarray:
    """Pixels of a text of digits, `. - + s` and blanks. [5 * scale, width] bool."""
    unknown = sorted(set(text) - set(_GLYPHS))
    if unknown:
        raise ValueError(f"caption {text!r} has {unknown}; captions hold {''.join(_GLYPHS)!r} only")
    glyphs = [[[int(row) >> (2 - column) & 1 for column in range(3)] + [0] for row in _GLYPHS[c]] for c in text]
    dots = np.concatenate([np.asarray(glyph, bool) for glyph in glyphs], axis=1)
    return np.kron(dots, np.ones((GLYPH_SCALE, GLYPH_SCALE), bool))


def film_strip(images: Sequence[np.ndarray], captions: Sequence[str], *, columns: int | None = None) -> np.ndarray:
    """Lays pictures of one size out in rows of `columns` (default: one row). Returns uint8 [height, width, 3]."""
    if not images or len(images) != len(captions):
        raise ValueError(f"{len(images)} pictures and {len(captions)} captions; give one caption a picture")
    if len({image.shape for image in images}) != 1:
        raise ValueError(f"pictures differ in shape: {[image.shape for image in images]}")
    columns = columns or len(images)
    height, width = images[0].shape[:2]
    rows = -(-len(images) // columns)
    cell_height, cell_width = height + CAPTION_PX + GUTTER_PX, width + GUTTER_PX
    strip = np.full((rows * cell_height + GUTTER_PX, columns * cell_width + GUTTER_PX, 3), BACKGROUND, np.uint8)
    for k, (image, caption) in enumerate(zip(images, captions, strict=True)):
        top, left = GUTTER_PX + k // columns * cell_height, GUTTER_PX + k % columns * cell_width
        mask = text_mask(caption)[:, :width]
        caption_top = top + (CAPTION_PX - mask.shape[0]) // 2
        strip[caption_top : caption_top + mask.shape[0], left : left + mask.shape[1]][mask] = INK
        strip[top + CAPTION_PX : top + CAPTION_PX + height, left : left + width] = image
    return strip
