"""The gate's forward pass (models/gate.py) as one kernel: reads x and y, writes out and what the backward pass needs.

Traffic: 6 arrays of rows, 3 where nothing is kept; XLA moves 23. Both blocks of a pair compute all of r: h of a half
needs r x of both.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import mosaic_gpu as plgpu

from jax2d.scene import Array
from kinetix_dist.models.kernels.tiles import (
    HALF,
    OTHER,
    OWN,
    ROWS,
    WIDTH,
    Products,
    Tiles,
    call,
    load_blocks,
    scratch,
)

# Blocks of the packed weights (y: r z h, x: r z, then h of r x), in shared memory in this order.
_HALVES = (OWN, OTHER)
_WHERE = [(row, part, column) for part in (0, 3) for column in _HALVES for row in _HALVES]
_WHERE += [(row, part, OWN) for part in (1, 4, 2, 5) for row in _HALVES]
_R_OF_Y, _R_OF_X, _Z_OF_Y, _Z_OF_X, _H_OF_Y, _H_OF_RX = 0, 4, 8, 10, 12, 14


@functools.partial(jax.jit, static_argnames=("keep", "interpret"))
def gate_forward(x: Array, y: Array, weights: Array, *, keep: bool, interpret: bool = False) -> tuple[Array, ...]:
    """(out, r, z, h), or (out,) where nothing is to be kept, each [rows, 128] bfloat16 like x and y; rows a multiple of
    64. weights: `gate.pack`."""
    like = jax.ShapeDtypeStruct(x.shape, x.dtype)
    blocks, loads, stores, weights_barrier, barriers = scratch(len(_WHERE), len(_WHERE) + 1)
    bias = plgpu.SMEM((HALF,), jnp.bfloat16)
    kernel = call(
        functools.partial(_body, keep=keep, interpret=interpret),
        (like,) * (4 if keep else 1),
        [blocks, bias, loads, stores, weights_barrier, barriers],
        interpret,
    )
    return kernel(x, y, weights)


def _body(
    # Rows in:
    x: Any,
    y: Any,
    weights: Any,
    # Rows out: out, then r, z and h if these are kept. Shared memory: blocks, bias, loads, stores; barriers.
    *refs: Any,
    keep: bool,
    interpret: bool,
) -> None:
    out, *kept = refs[:-6]
    blocks, bias, loads, stores, weights_barrier, barriers = refs[-6:]
    order = [(y, OWN), (y, OTHER), (x, OWN), (x, OTHER)]
    tiles = Tiles(x.shape[0], order, loads, stores, barriers)
    load_blocks(tiles, weights, blocks, weights_barrier, _WHERE)

    @pl.when(tiles.warpgroup == 0)
    def _() -> None:
        plgpu.copy_gmem_to_smem(weights.at[WIDTH, tiles.half(OWN)], bias, weights_barrier)

    plgpu.barrier_wait(weights_barrier)
    own = tiles.half(OWN)

    def store(which: int, value: Any) -> None:
        if keep:
            tiles.give(kept[which], own, value)

    def tile(number: Any) -> None:
        products = Products(blocks, number, transposed=False, interpret=interpret)
        y_halves = [tiles.take(), tiles.take()]
        x_halves, rx_halves, z_own = [], [], []

        def issue_r(half: int) -> Any:
            def issue(total: Any) -> None:
                products.add(total, y_halves, _R_OF_Y + 2 * half)
                if half == OWN:  # x arrives behind the first products
                    x_halves.extend((tiles.take(), tiles.take()))
                products.add(total, x_halves, _R_OF_X + 2 * half)

            return issue

        def finish_r(half: int) -> Any:
            def finish(total: Any) -> None:
                r = _sigmoid(total)
                if half == OWN:
                    store(0, r)
                rx_halves.append((r * x_halves[half].astype(jnp.float32)).astype(jnp.bfloat16))

            return finish

        def issue_z(total: Any) -> None:
            products.add(total, y_halves, _Z_OF_Y)
            products.add(total, x_halves, _Z_OF_X)

        def finish_z(total: Any) -> None:
            columns = plgpu.load(bias, (), layout=plgpu.Layout.WGMMA.reduce(0)).astype(jnp.float32)
            z = _sigmoid(total - jax.lax.broadcast_in_dim(columns, (ROWS, HALF), (1,))).astype(jnp.bfloat16)
            z_own.append(z)
            store(1, z)

        def issue_h(total: Any) -> None:
            products.add(total, y_halves, _H_OF_Y)
            products.add(total, rx_halves, _H_OF_RX)

        def finish_h(total: Any) -> None:
            h = jnp.tanh(total)
            store(2, h)
            x_own = x_halves[OWN].astype(jnp.float32)
            tiles.give(out, own, x_own + z_own[0].astype(jnp.float32) * (h - x_own))

        products.chain(
            (issue_r(OWN), finish_r(OWN)),
            (issue_r(OTHER), finish_r(OTHER)),
            (issue_z, finish_z),
            (issue_h, finish_h),
        )

    tiles.each(tile)


def _sigmoid(x: Any) -> Any:
    return 0.5 * jnp.tanh(0.5 * x) + 0.5  # tanh is one instruction
