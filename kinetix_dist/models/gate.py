"""Gated residual connection (GTrXL, Parisotto et al. 2019) with its products grouped by input.

    r = sigmoid(y W_r + x U_r)         h   = tanh(y W_h + (r x) U_h)
    z = sigmoid(y W_z + x U_z - b)     out = (1 - z) x + z h

Six products become three: y [W_r W_z W_h], x [U_r U_z] and (r x) U_h, and six gradients of inputs become three as
well. A gate moves more memory than anything else in the network; what the backward pass needs (r, z, h, r x) is kept
in the type of the activations.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array


@jax.custom_vjp
def gate(x: Array, y: Array, kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array) -> Array:
    """Lets `y` into the residual stream `x`, both [..., F]; a higher bias keeps more of `x`.

    kernel_y: [F, 3F] for r, z, h; kernel_x: [F, 2F] for r, z; kernel_h: [F, F]; bias: [F]. Kernels are float32.
    """
    return _gate_forward(x, y, kernel_y, kernel_x, kernel_h, bias)[0]


def _gate_forward(
    x: Array, y: Array, kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array
) -> tuple[Array, tuple[Array, ...]]:
    dtype, width = x.dtype, x.shape[-1]
    from_y = y @ kernel_y.astype(dtype)
    from_x = x @ kernel_x.astype(dtype)
    r = jax.nn.sigmoid(from_y[..., :width] + from_x[..., :width])
    z = jax.nn.sigmoid(from_y[..., width : 2 * width] + from_x[..., width:] - bias.astype(dtype))
    rx = r * x
    h = jnp.tanh(from_y[..., 2 * width :] + rx @ kernel_h.astype(dtype))
    out = x + z * (h - x)
    return out, (x, y, r, z, rx, h, kernel_y, kernel_x, kernel_h, bias)


def _gate_backward(residuals: tuple[Array, ...], grad: Array) -> tuple[Array, ...]:
    x, y, r, z, rx, h, kernel_y, kernel_x, kernel_h, bias = residuals
    dtype, width = x.dtype, x.shape[-1]
    once = jax.lax.optimization_barrier  # stored, where XLA would compute it again in front of each product
    grad_z = grad * (h - x) * z * (1 - z)
    grad_h = once(grad * z * (1 - h * h))
    grad_rx = grad_h @ kernel_h.astype(dtype).T
    grad_r = grad_rx * x * r * (1 - r)
    grad_all = once(jnp.concatenate([grad_r, grad_z, grad_h], axis=-1))  # of the three arguments of the nonlinearities
    grad_y = grad_all @ kernel_y.astype(dtype).T
    # Zeros for h: whole rows of grad_all enter every product, a slice of it would be a copy.
    kernel_x_padded = jnp.pad(kernel_x.astype(dtype), ((0, 0), (0, width)))
    grad_x = once(grad * (1 - z) + grad_rx * r + grad_all @ kernel_x_padded.T)
    grad_bias = -jnp.sum(grad_all[..., width : 2 * width].astype(jnp.float32), axis=range(grad.ndim - 1))
    return (
        grad_x,
        grad_y,
        outer(y, grad_all),
        outer(x, grad_all)[:, : 2 * width],
        outer(rx, grad_h),
        grad_bias.astype(bias.dtype),
    )


def outer(x: Array, grad: Array) -> Array:
    """Gradient of a kernel in float32: sum over rows of x^T grad."""
    rows = x.reshape(-1, x.shape[-1])
    return jnp.matmul(rows.T, grad.reshape(-1, grad.shape[-1]), preferred_element_type=jnp.float32)


gate.defvjp(_gate_forward, _gate_backward)
