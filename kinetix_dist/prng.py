"""Random numbers that do not depend on JAX's settings: keys say their implementation, draws their type.

    key = prng.key(seed)
    first, second = prng.split(key)
    prng.uniform(first, (3,))  # [3] float32

`jax.random` reads them from the process: `JAX_DEFAULT_PRNG_IMPL` makes other keys of a seed, `JAX_ENABLE_X64` draws 64
bits where no type is given, `JAX_THREEFRY_PARTITIONABLE` splits and draws otherwise, `JAX_RANDOM_SEED_OFFSET` moves
seeds. A set of held-out levels would be another one under the same name. This module has the same functions, with the
same numbers as under JAX's defaults; nothing else of the package calls `jax.random`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array | np.ndarray

IMPLEMENTATION = "threefry2x32"
MASK = 0xFFFFFFFF  # of a seed: 32 bits, as JAX takes them without 64-bit types

# These read no settings.
fold_in = jax.random.fold_in
key_data = jax.random.key_data
key_impl = jax.random.key_impl


@contextlib.contextmanager
def pinned() -> Iterator[None]:
    """Settings under which code of others, such as an initializer of Flax, draws what it draws by default.

    JAX keeps `jax_threefry_partitionable` with each operation that it traces, so that this holds inside jit too.
    """
    with jax.threefry_partitionable(True), jax.default_prng_impl(IMPLEMENTATION):
        yield


def key(seed: int | Array) -> jax.Array:
    """A typed key of the lower 32 bits of a seed, which may be traced."""
    low = np.uint32(int(seed) & MASK) if isinstance(seed, int | np.integer) else jnp.asarray(seed).astype(jnp.uint32)
    return wrap_key_data(jnp.stack([jnp.zeros_like(low), low]))


def wrap_key_data(data: Array, impl: str = IMPLEMENTATION) -> jax.Array:
    """The typed key of its `key_data`."""
    return jax.random.wrap_key_data(jnp.asarray(data), impl=impl)


def split(key: jax.Array, num: int = 2) -> jax.Array:
    """[num] keys."""
    with pinned():
        return jax.random.split(key, num)


def uniform(key: jax.Array, shape: Sequence[int] = (), minval: float = 0.0, maxval: float = 1.0) -> jax.Array:
    """float32 in [minval, maxval)."""
    with pinned():
        return jax.random.uniform(key, shape, jnp.float32, minval, maxval)


def normal(key: jax.Array, shape: Sequence[int] = ()) -> jax.Array:
    """float32 of mean 0 and variance 1."""
    with pinned():
        return jax.random.normal(key, shape, jnp.float32)


def randint(key: jax.Array, shape: Sequence[int], minval: int | Array, maxval: int | Array) -> jax.Array:
    """int32 in [minval, maxval)."""
    with pinned():
        return jax.random.randint(key, shape, minval, maxval, jnp.int32)


def bits(key: jax.Array, shape: Sequence[int] = ()) -> jax.Array:
    """uint32, all values equally likely."""
    with pinned():
        return jax.random.bits(key, shape, jnp.uint32)


def categorical(key: jax.Array, logits: Array, shape: Sequence[int] | None = None) -> jax.Array:
    """int32 indices into the last axis of float32 logits, by their softmax."""
    with pinned():
        return jax.random.categorical(key, logits, shape=shape, mode="low").astype(jnp.int32)
