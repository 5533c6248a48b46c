"""Simple noise scale of the gradient (McCandlish et al. 2018, "An Empirical Model of Large-Batch Training").

A gradient G_n of n samples has E |G_n|^2 = |G|^2 + tr(Sigma) / n, with G the true gradient and Sigma the covariance
over samples. A minibatch of N samples in P parts, part p with n_p of them, gives squares at two sizes:

    small = sum_p n_p / N |G_p|^2           E small = |G|^2 + P tr(Sigma) / N
    whole = |sum_p n_p / N G_p|^2           E whole = |G|^2 + tr(Sigma) / N

    tr(Sigma) = N (small - whole) / (P - 1)         |G|^2 = (P whole - small) / (P - 1)         both without bias
    noise scale = tr(Sigma) / |G|^2, in samples

Parts are the samples of each device, or on one device the two halves of its samples: those of other virtual shards,
and so of other worlds, where there are two shards or more. Samples of one world are alike, so that parts which shared
worlds would show too little noise. Squares are averaged over the gradient steps of an update before the ratio is taken;
|G|^2 of a few steps may still come out negative where the noise scale is far above N.
"""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array

METRICS = ("gradient_noise_scale", "gradient_variance", "gradient_square")


def num_parts(num_devices: int) -> int:
    """P."""
    return max(num_devices, 2)


def parts_here(index: Array, num_devices: int, *, num_rows: int) -> list[Array]:
    """Sample numbers of the parts that this device computes, from those of its minibatch.

    num_rows: rows of worlds that `index` holds one after the other, each of which is cut: the steps of a recurrent
    policy's worlds, else 1.
    """
    if num_devices > 1:
        return [index]
    rows = index.reshape(num_rows, -1)
    half = rows.shape[1] // 2
    return [rows[:, :half].reshape(-1), rows[:, half:].reshape(-1)]


def part_square(share: Array, num_samples: Array | int, minibatch_size: int) -> Array:
    """Share of a part in `small`. share: n_p / N G_p; num_samples: n_p."""
    return jnp.sum(jnp.square(share)) * (minibatch_size / num_samples)


def noise_metrics(small: Array, whole: Array, parts: int, minibatch_size: int) -> dict[str, Array]:
    """METRICS of an update, from the means of both squares over its gradient steps."""
    variance = minibatch_size * (small - whole) / (parts - 1)
    square = (parts * whole - small) / (parts - 1)
    return dict(zip(METRICS, (variance / square, variance, square), strict=True))
