"""Pictures of very many worlds at once, on the device: JAX inside jit, uint8 [..., 125, 125, 3] out.

A picture is a stack of convex primitives, painted one over another. Each is painted from its signed distance d in
pixels, negative inside, as in `jax2d.rasteriser`:

    cover = opacity clip(1/2 - d, 0, 1)      inner = opacity clip(1/2 - (d + outline width), 0, 1)
    picture = (1 - cover) picture + (cover - inner) outline colour + inner colour

All primitives are painted in one elementwise loop over pixels, whose only result is one 32-bit word a pixel: red,
green and blue in its lower bytes. Lines thinner than a pixel are a pixel wide and that much fainter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.palette import BACKGROUND
from jax2d.scene import Array
from kinetix_dist.level.level import WORLD_SIZE_M

PIXELS = 125  # rows and columns: 500 at 100 a metre, downscaled by 4
PIXELS_A_METRE = PIXELS / WORLD_SIZE_M
# Painted band by band: XLA does not fuse a loop with what follows, which would paint all once for each byte of a word.
NUM_BANDS = 5
ROWS_A_BAND = PIXELS // NUM_BANDS


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Primitive:
    """One convex thing to paint in every world: the inside of all its edges, or of its disc. [..., ] worlds."""

    edges: Array | None = None  # [..., E, 3] outward normal (unit) and its product with a point of the edge, m
    centre: Array | None = None  # [..., 2] m, of a disc
    radius: Array | None = None  # [...] m
    colour: Array  # [..., 3] float32 0..255
    outline: Array  # [..., 3]
    outline_width: float = dataclasses.field(default=0.0, metadata={"static": True})  # m
    opacity: Array  # [...] 0..1, 0: not there


def paint(primitives: Sequence[Primitive], under: Array) -> Array:
    """Paints in order over `under`, packed pictures [..., 125, 125] uint32; later things over earlier ones. All numbers
    have to be finite."""
    bands = jax.lax.map(lambda band: _paint_band(primitives, under, band), jnp.arange(NUM_BANDS))
    return jnp.moveaxis(bands, 0, -3).reshape(under.shape)


def _paint_band(primitives: Sequence[Primitive], under: Array, band: Array) -> Array:
    """[..., rows of a band, 125] uint32."""
    row = (band * ROWS_A_BAND + np.arange(ROWS_A_BAND, dtype=np.float32) + 0.5)[:, None]
    x = jnp.asarray((np.arange(PIXELS, dtype=np.float32) + 0.5) / PIXELS_A_METRE)
    y = WORLD_SIZE_M - row / PIXELS_A_METRE
    under = jax.lax.dynamic_slice_in_dim(under, band * ROWS_A_BAND, ROWS_A_BAND, axis=-2)
    red, green, blue = ((under >> shift & 0xFF).astype(jnp.float32) for shift in (0, 8, 16))
    for primitive in primitives:
        distance, opacity = _distance(primitive, x, y), _pixel(primitive.opacity)
        cover = opacity * jnp.clip(0.5 - distance, 0.0, 1.0)
        inner = opacity * jnp.clip(0.5 - distance - primitive.outline_width * PIXELS_A_METRE, 0.0, 1.0)
        red, green, blue = (
            channel * (1.0 - cover) + (cover - inner) * _pixel(outline) + inner * _pixel(colour)
            for channel, outline, colour in zip(
                (red, green, blue), jnp.moveaxis(primitive.outline, -1, 0), jnp.moveaxis(primitive.colour, -1, 0)
            )
        )
    red, green, blue = (jnp.floor(channel + 0.5).astype(jnp.uint32) for channel in (red, green, blue))
    return red | green << 8 | blue << 16


def blank(shape: Sequence[int]) -> Array:
    """Packed pictures of nothing, [*shape, 125, 125] uint32."""
    red, green, blue = BACKGROUND
    return jnp.full((*shape, PIXELS, PIXELS), red | green << 8 | blue << 16, jnp.uint32)


def unpack(packed: Array) -> Array:
    """[..., 125, 125] uint32 to [..., 125, 125, 3] uint8: red, green, blue; row 0 is the top."""
    return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]


def edges_of(vertices: Array) -> Array:
    """Edges [..., V, 3] of convex polygons [..., V, 2], counter-clockwise. Slots that repeat a vertex have none."""
    along = jnp.roll(vertices, -1, axis=-2) - vertices
    length = jnp.linalg.norm(along, axis=-1, keepdims=True)
    outward = jnp.stack([along[..., 1], -along[..., 0]], axis=-1) / jnp.where(length > 0, length, 1.0)
    offset = jnp.sum(outward * vertices, axis=-1, keepdims=True)
    # No edge: a half-plane that holds everything.
    return jnp.concatenate([outward, jnp.where(length > 0, offset, EVERYWHERE_M)], axis=-1)


def line_edges(length: float | Array, width: float, angle: float | Array) -> tuple[Array, float]:
    """(edges [..., 4, 3], opacity) of a line about the origin. length m, width m, angle rad of its direction."""
    seen_width = max(width, 1.0 / PIXELS_A_METRE)
    half = jnp.stack(jnp.broadcast_arrays(0.5 * (jnp.asarray(length) + width), 0.5 * seen_width), axis=-1)
    corners = half[..., None, :] * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], np.float32)
    cos, sin = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
    turned = jnp.stack(
        [cos * corners[..., 0] - sin * corners[..., 1], sin * corners[..., 0] + cos * corners[..., 1]], axis=-1
    )
    return edges_of(turned), width / seen_width


def turn(edges: Array, angle: Array, place: Array) -> Array:
    """Edges [..., E, 3] about the origin, turned by angle [...] and moved to place [..., 2] m."""
    cos, sin = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
    normal_x = cos * edges[..., 0] - sin * edges[..., 1]
    normal_y = sin * edges[..., 0] + cos * edges[..., 1]
    offset = edges[..., 2] + normal_x * place[..., None, 0] + normal_y * place[..., None, 1]
    return jnp.stack([normal_x, normal_y, offset], axis=-1)


EVERYWHERE_M = 1e6  # a half-plane with its edge so far away


def _distance(primitive: Primitive, x: Array, y: Array) -> Array:
    """Signed distance in pixels, [..., rows, 125]."""
    parts = []
    if primitive.edges is not None:
        for edge in range(primitive.edges.shape[-2]):
            normal_x, normal_y, offset = (_pixel(primitive.edges[..., edge, i]) for i in range(3))
            parts.append(normal_x * x + normal_y * y - offset)
    if primitive.centre is not None:
        centre_x, centre_y = (_pixel(primitive.centre[..., i]) for i in range(2))
        parts.append(jnp.sqrt(jnp.square(x - centre_x) + jnp.square(y - centre_y)) - _pixel(primitive.radius))
    distance = parts[0]
    for part in parts[1:]:
        distance = jnp.maximum(distance, part)
    return distance * PIXELS_A_METRE


def _pixel(number: Array) -> Array:
    """[...] as [..., 1, 1], the same for all pixels."""
    return number[..., None, None]
