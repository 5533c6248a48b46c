"""Results that a GPU stores before they are used.

XLA fuses what it can, also where a loop then computes the same number many times over or cuts an array across its rows:
kernels of norms, sums over a batch and means took up to ten times as long as their traffic (bench/step_profile.py).
`stored` keeps what comes before from what comes after. CPUs fuse by other rules and gain nothing by it.
"""

from __future__ import annotations

from typing import TypeVar

import jax

from jax2d.scene import Array

Arrays = TypeVar("Arrays")  # an array, or a tree of them


def stored(x: Arrays) -> Arrays:
    """`x`; on a GPU, whatever uses it reads it from memory."""
    return jax.lax.platform_dependent(x, cpu=lambda x: x, default=jax.lax.optimization_barrier)


@jax.custom_vjp
def stored_gradient(x: Array) -> Array:
    """`x`, whose gradient is `stored`."""
    return x


stored_gradient.defvjp(lambda x: (x, None), lambda _, grad: (stored(grad),))
