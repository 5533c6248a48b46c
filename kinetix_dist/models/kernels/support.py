"""Support of the fused kernels: where they run, and the setting that chooses them, `policy.kernels`.

"xla"     models/layer.py and models/gate.py, on any device; the reference
"fused"  the kernels, refused where they cannot run: gates by Pallas Mosaic GPU, which is part of jax, the other parts
          of a layer in CUDA C++, compiled by a library that comes with jax
"auto"    the kernels where they can run, else XLA
"""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
from collections.abc import Iterator

import jax

from kinetix_dist.models.kernels.nvrtc import NvrtcError, check_compiler, compiler_version

KERNELS = ("auto", "xla", "fused")
WIDTH = 128  # of tokens
HEADS, ATTENTION_FEATURES = 8, 16  # of all heads together
MULTIPROCESSORS = 132  # of an H100 or H200
DTYPE = "bfloat16"
JAX_VERSIONS = ("0.11",)  # Pallas, and what XLA takes as a kernel, change between minor versions
CAPABILITY = "9.0"  # Hopper: wgmma and the copy engine
# Tiles of messages (cuda/messages.cu): with these many rows of tokens, and of messages, two blocks of the kernels share
# a multiprocessor's memory. Products have 16 rows.
MAX_TOKEN_ROWS, MAX_MESSAGE_ROWS, PRODUCT_ROWS = 160, 112, 16
MAX_FEATURES = 127  # of an entity (cuda/encoders.cu): then kernels of two groups fit in a multiprocessor's memory
BITS = 32  # of a word of a mask: a world's tokens in attention, its ends of joints and thrusters in messages


class KernelError(ValueError):
    """Requested kernels cannot run here."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LayerShape:
    """Shape of a layer, as far as kernels are written for it."""

    width: int
    dtype: str
    is_gated: bool
    num_heads: int
    attention_features: int
    num_tokens: int  # of a world
    num_joints: int  # messages along them: two each
    num_thrusters: int
    num_features: int  # of an entity, at most


def worlds_a_message_tile(num_tokens: int, num_joints: int, num_thrusters: int) -> int:
    """So many that their products are as full as can be, as many as fit; 0: none do."""

    def rows(worlds: int) -> int:
        return sum(-(-worlds * count // PRODUCT_ROWS) * PRODUCT_ROWS for count in (num_joints, num_thrusters))

    fitting = [worlds for worlds in range(1, MAX_TOKEN_ROWS // num_tokens + 1) if rows(worlds) <= MAX_MESSAGE_ROWS]
    return max(fitting, key=lambda worlds: (worlds / rows(worlds), worlds), default=0)


def why_no_network(layer: LayerShape) -> str:
    """Reason against the kernels for a network with such layers; "": none."""
    if not layer.is_gated:
        return "policy.network has no gates and the kernels are written for those that have"
    for name, value, written_for in (
        ("policy.encoder_size", layer.width, WIDTH),
        ("policy.dtype", layer.dtype, DTYPE),
        ("policy.num_heads", layer.num_heads, HEADS),
        ("policy.attention_features", layer.attention_features, ATTENTION_FEATURES),
    ):
        if value != written_for:
            return f"{name} is {value} and the kernels are written for {written_for}"
    if not layer.num_joints or not layer.num_thrusters:
        return f"worlds have no {'thrusters' if layer.num_joints else 'joints'} and the kernels need them"
    if layer.num_features > MAX_FEATURES:
        return f"entities have {layer.num_features} features and the kernels take {MAX_FEATURES}"
    num_ends = layer.num_joints + layer.num_thrusters
    for count, of_what in ((layer.num_tokens, "tokens"), (num_ends, "ends of joints and thrusters")):
        if count > BITS:
            return f"worlds have {count} {of_what} and the kernels take {BITS}"
    if not worlds_a_message_tile(layer.num_tokens, layer.num_joints, layer.num_thrusters):
        return f"worlds have {num_ends} ends of joints and thrusters, which fit in no tile of the kernels"
    return ""


_target: contextvars.ContextVar[jax.Device | None] = contextvars.ContextVar("target", default=None)


@contextlib.contextmanager
def compiling_for(device: jax.Device) -> Iterator[None]:
    """Programs traced inside are for `device`, which may be a described one, not for the first of this process. A
    function that was traced before is not traced again: jit functions have to be new."""
    token = _target.set(device)
    try:
        yield
    finally:
        _target.reset(token)


def why_no_device() -> str:
    """Reason against the kernels on the device that programs are for; "": none."""
    if not jax.__version__.startswith(JAX_VERSIONS):
        return f"jax is {jax.__version__} and the kernels are written for {' or '.join(JAX_VERSIONS)} (Python 3.12)"
    device = _target.get() or jax.local_devices()[0]
    if device.platform != "gpu":
        return f"the device is a {device.platform.upper()} and the kernels are written for Hopper GPUs"
    if device.compute_capability != CAPABILITY:
        found = f"{device.device_kind} has compute capability {device.compute_capability}"
        return f"{found} and the kernels need {CAPABILITY}"
    try:
        check_compiler()
    except NvrtcError as error:
        return str(error)
    return ""


def traced_for() -> tuple[object, ...]:
    """Cache key of tracing a network, next to its configuration: the device, and the compiler of kernels."""
    device = _target.get() or jax.local_devices()[0]
    why_not = why_no_device()
    return device.platform, device.device_kind, why_not, () if why_not else compiler_version()


def uses_fused(kernels: str, layer: LayerShape) -> bool:
    """The kernels compute the network. Raises KernelError where "fused" cannot be."""
    if kernels == "xla":
        return False
    why_not = why_no_network(layer) or why_no_device()
    if kernels == "fused" and why_not:
        raise KernelError(f"policy.kernels is 'fused', but {why_not}; use 'auto' or 'xla'")
    return not why_not
