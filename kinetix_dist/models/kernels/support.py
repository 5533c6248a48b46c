"""Where the kernels of this folder run, and the setting that chooses them: `policy.kernels`.

"xla"     models/gate.py, on any device; the reference
"mosaic"  the kernels (Pallas Mosaic GPU, part of jax); refused where they cannot run
"auto"    the kernels where they can run, else XLA
"""

from __future__ import annotations

import jax

KERNELS = ("auto", "xla", "mosaic")
WIDTH = 128  # of tokens
DTYPE = "bfloat16"
JAX_VERSIONS = ("0.11",)  # Pallas changes between minor versions
CAPABILITY = "9.0"  # Hopper: wgmma and the copy engine


class KernelError(ValueError):
    """Kernels were asked for that cannot run here."""


def why_no_network(width: int, dtype: str) -> str:
    """What keeps the kernels from a network whose tokens are so wide and of this type; empty: nothing."""
    if width != WIDTH:
        return f"policy.encoder_size is {width} and the kernels are written for {WIDTH}"
    if dtype != DTYPE:
        return f"policy.dtype is {dtype} and the kernels are written for {DTYPE}"
    return ""


def why_no_device() -> str:
    """What keeps the kernels from the first device of this process; empty: nothing."""
    if not jax.__version__.startswith(JAX_VERSIONS):
        return f"jax is {jax.__version__} and the kernels are written for {' or '.join(JAX_VERSIONS)} (Python 3.12)"
    device = jax.local_devices()[0]
    if device.platform != "gpu":
        return f"the device is a {device.platform.upper()} and the kernels are written for Hopper GPUs"
    if device.compute_capability != CAPABILITY:
        found = f"{device.device_kind} has compute capability {device.compute_capability}"
        return f"{found} and the kernels need {CAPABILITY}"
    return ""


def uses_mosaic(kernels: str, width: int, dtype: str) -> bool:
    """Whether a network is computed by the kernels. Raises KernelError where "mosaic" cannot be."""
    if kernels == "xla":
        return False
    why_not = why_no_network(width, dtype) or why_no_device()
    if kernels == "mosaic" and why_not:
        raise KernelError(f"policy.kernels is 'mosaic', but {why_not}; use 'auto' or 'xla'")
    return not why_not
