"""The gate's backward pass (models/gate.py) as one kernel, but for gradients of its kernels (gate_weights.py).

    grad_z = grad (h - x) z (1 - z)        grad_x = grad (1 - z) + grad_rx r + [grad_r, grad_z] [U_r, U_z]^T
    grad_h = grad z (1 - h^2)              grad_y = [grad_r, grad_z, grad_h] [W_r, W_z, W_h]^T
    grad_r = grad_rx x r (1 - r)           grad_rx = grad_h U_h^T

Traffic: 11 arrays of rows. Both blocks of a pair compute all of grad_r, grad_z and grad_h, which every column of grad_x
and grad_y needs.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.pallas import mosaic_gpu as plgpu

from jax2d.scene import Array
from kinetix_dist.models.kernels.tiles import OTHER, OWN, WIDTH, Products, Tiles, call, load_blocks, scratch

# Blocks of the packed weights, used transposed: columns of the kernel are the rows of the product.
_HALVES = (OWN, OTHER)
_WHERE = [(row, 5, column) for row in _HALVES for column in _HALVES]  # U_h
_WHERE += [(OWN, part, column) for part in (0, 1, 2, 3, 4) for column in _HALVES]  # W_r W_z W_h U_r U_z
_RX, _Y_OF_R, _Y_OF_Z, _Y_OF_H, _X_OF_R, _X_OF_Z = 0, 4, 6, 8, 10, 12


@functools.partial(jax.jit, static_argnames="interpret")
def gate_backward(
    grad: Array, x: Array, r: Array, z: Array, h: Array, weights: Array, *, interpret: bool = False
) -> tuple[Array, Array, Array, Array, Array]:
    """(grad_x, grad_y, [grad_r, grad_z] [rows, 256], grad_h, r x); others are [rows, 128] bfloat16, rows a multiple
    of 64. weights: `gate.pack`."""
    like = jax.ShapeDtypeStruct(x.shape, x.dtype)
    two = jax.ShapeDtypeStruct((x.shape[0], 2 * WIDTH), x.dtype)
    kernel = call(
        functools.partial(_body, interpret=interpret),
        (like, like, two, like, like),
        scratch(len(_WHERE), len(_WHERE)),
        interpret,
    )
    return kernel(grad, x, r, z, h, weights)


class _Refs(NamedTuple):
    """Arguments of the kernel."""

    # Rows in:
    grad: Any
    x: Any
    r: Any
    z: Any
    h: Any
    weights: Any
    # Rows out:
    grad_x: Any
    grad_y: Any
    grad_rz: Any
    grad_h: Any
    rx: Any
    # Shared memory:
    blocks: Any
    loads: Any
    stores: Any
    weights_barrier: Any
    barriers: Any


def _body(*refs: Any, interpret: bool) -> None:
    ref = _Refs(*refs)
    # The own half last, since what is stored of it is at hand then. x comes twice: registers have no room for it.
    order = [(array, half) for half in (OTHER, OWN) for array in (ref.z, ref.h, ref.grad, ref.x)]
    order += [(array, half) for half in (OTHER, OWN) for array in (ref.r, ref.x)]
    tiles = Tiles(ref.x.shape[0], order, ref.loads, ref.stores, ref.barriers)
    load_blocks(tiles, ref.weights, ref.blocks, ref.weights_barrier, _WHERE)
    plgpu.barrier_wait(ref.weights_barrier)
    own, second_own = tiles.half(OWN), tiles.half(OWN, 1)

    def tile(number: Any) -> None:
        products = Products(ref.blocks, number, transposed=True, interpret=interpret)
        h_halves, z_halves, r_halves = [None, None], [None, None], [None, None]
        direct: Any = None  # of grad_x: what reaches the own half without a product
        for half in (OTHER, OWN):
            z_half, h_half, grad_half, x_half = (tiles.take().astype(jnp.float32) for _ in range(4))
            z_halves[half] = (grad_half * (h_half - x_half) * z_half * (1 - z_half)).astype(jnp.bfloat16)
            through_h = grad_half * z_half
            h_halves[half] = (through_h * (1 - h_half * h_half)).astype(jnp.bfloat16)
            if half == OWN:
                direct = (grad_half - through_h).astype(jnp.bfloat16)
                tiles.give(ref.grad_h, own, h_halves[OWN])
                tiles.give(ref.grad_rz, second_own, z_halves[OWN])

        def finish_rx(half: int) -> Any:
            def finish(grad_rx: Any) -> None:
                nonlocal direct
                r_half, x_half = tiles.take().astype(jnp.float32), tiles.take().astype(jnp.float32)
                rx_half = r_half * x_half
                r_halves[half] = (grad_rx * rx_half * (1 - r_half)).astype(jnp.bfloat16)
                if half == OWN:
                    direct = (direct.astype(jnp.float32) + grad_rx * r_half).astype(jnp.bfloat16)
                    tiles.give(ref.rx, own, rx_half)
                    tiles.give(ref.grad_rz, own, r_halves[OWN])

            return finish

        def issue_y(total: Any) -> None:
            products.add(total, z_halves, _Y_OF_Z)
            products.add(total, h_halves, _Y_OF_H)
            products.add(total, r_halves, _Y_OF_R)

        def issue_x(total: Any) -> None:
            products.add(total, z_halves, _X_OF_Z)
            products.add(total, r_halves, _X_OF_R)

        products.chain(
            (lambda total: products.add(total, h_halves, _RX + 2 * OTHER), finish_rx(OTHER)),
            (lambda total: products.add(total, h_halves, _RX + 2 * OWN), finish_rx(OWN)),
            (issue_y, lambda total: tiles.give(ref.grad_y, own, total)),
            (issue_x, lambda total: tiles.give(ref.grad_x, own, direct.astype(jnp.float32) + total)),
        )

    tiles.each(tile)
