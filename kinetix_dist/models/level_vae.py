"""A generative model of levels: a variational autoencoder (Kingma and Welling 2014) of their vectors, as in DRED
(Garcin et al. 2024, "DRED: Zero-Shot Transfer in Reinforcement Learning via Data-Regularised Environment Design").

    model, losses = fit(levels, key, capacity, generator, VaeConfig())
    model.generate(key, 64)         new levels like those that it learned from; a `LevelGenerator`
    model.reconstruct(key, levels)  what is left of levels after encoding and decoding

    loss = |x - decode(z)|^2 + kl_coefficient KL(N(mean, std) || N(0, 1)),  z = mean + std noise; both summed

New levels lie between two of the set, as in DRED: their latents are interpolated, so that what all levels of a set have
in common stays. What is decoded is repaired (`level/vectors.py`), so that every level is valid; of twice as many those
that overlap at the start are left out.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.level.generator import OVERSAMPLING, keep_unsolved
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level
from kinetix_dist.level.vectors import (
    check_describable,
    from_vector,
    num_order_draws,
    overlaps_at_start,
    to_vector,
    vector_size,
)
from kinetix_dist.setting import check_finite


@dataclasses.dataclass(frozen=True, kw_only=True)
class VaeConfig:
    """The network and how it is trained."""

    latent_size: int = 32
    hidden_size: int = 384  # of two layers, of encoder and of decoder
    kl_coefficient: float = 0.002
    learning_rate: float = 1e-3
    batch_size: int = 256
    num_steps: int = 3000  # gradient steps

    def __post_init__(self) -> None:
        check_finite(self, "VaeConfig")
        for name in ("latent_size", "hidden_size", "batch_size", "num_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"VaeConfig.{name} is {getattr(self, name)}; it must be 1 or more")
        if not self.learning_rate > 0 or self.kl_coefficient < 0:
            raise ValueError(
                f"VaeConfig has learning_rate {self.learning_rate}, kl_coefficient {self.kl_coefficient}; the one must "
                "be positive, the other 0 or more"
            )


class Vae(nn.Module):
    """Vectors [B, n] and noise [B, latent] -> (decoded [B, n], mean [B, latent], log of the variance [B, latent])."""

    config: VaeConfig
    vector_size: int

    def setup(self) -> None:
        hidden = self.config.hidden_size
        self.encoder = nn.Sequential([nn.Dense(hidden), nn.relu, nn.Dense(hidden), nn.relu])
        self.latent = nn.Dense(2 * self.config.latent_size)
        self.decoder = nn.Sequential([nn.Dense(hidden), nn.relu, nn.Dense(hidden), nn.relu, nn.Dense(self.vector_size)])

    def __call__(self, vectors: Array, noise: Array) -> tuple[Array, Array, Array]:
        mean, log_variance = self.encode(vectors)
        return self.decode(mean + jnp.exp(0.5 * log_variance) * noise), mean, log_variance

    def encode(self, vectors: Array) -> tuple[Array, Array]:
        mean, log_variance = jnp.split(self.latent(self.encoder(vectors)), 2, axis=-1)
        return mean, log_variance

    def decode(self, latent: Array) -> Array:
        return self.decoder(latent)


@dataclasses.dataclass(frozen=True)
class VaeLevels:
    """A trained model; a `LevelGenerator`."""

    params: Any
    latents: Array  # [N, latent_size], means of the levels of the set
    capacity: Capacity
    generator: GeneratorConfig
    config: VaeConfig

    def generate(self, key: Array, num_levels: int) -> Level:
        """Each between two levels of the set. Where more than half of the draws overlap, the last ones returned do."""
        pair_key, share_key, order_key = prng.split(key, 3)
        num_drawn = OVERSAMPLING * num_levels
        first, second = prng.randint(pair_key, (2, num_drawn), 0, self.latents.shape[0])
        share = prng.uniform(share_key, (num_drawn, 1))
        drawn = self.decode(order_key, share * self.latents[first] + (1.0 - share) * self.latents[second])
        overlaps = jax.vmap(lambda level: overlaps_at_start(level, self.capacity))(drawn)
        return keep_unsolved(drawn, overlaps, num_levels)

    def reconstruct(self, key: Array, levels: Level) -> Level:
        """Levels from the means of their latents. The key orders slots."""
        mean, _ = self._network.apply(self.params, _vectors(levels, self.capacity, self.generator), method=Vae.encode)
        return self.decode(key, mean)

    def decode(self, key: Array, latents: Array) -> Level:
        """Valid levels [B, ...] of latents [B, latent_size]. The key orders slots."""
        vectors = self._network.apply(self.params, latents, method=Vae.decode)
        draws = prng.uniform(key, (latents.shape[0], num_order_draws(self.capacity)))
        return jax.vmap(lambda vector, draw: from_vector(vector, draw, self.capacity, self.generator))(vectors, draws)

    @property
    def _network(self) -> Vae:
        return Vae(self.config, vector_size(self.capacity))


def fit(
    levels: Level, key: Array, capacity: Capacity, generator: GeneratorConfig, config: VaeConfig
) -> tuple[VaeLevels, Array]:
    """The model of a set of levels, [N, ...], and its loss at each step [num_steps]. Consumes the key.

    Raises ValueError for levels that vectors do not hold.
    """
    check_describable(levels)
    vectors = jax.jit(lambda levels: _vectors(levels, capacity, generator))(levels)
    network, optimizer = Vae(config, vector_size(capacity)), optax.adam(config.learning_rate)
    init_key, step_key = prng.split(key)

    def loss(params: Any, batch: Array, noise: Array) -> Array:
        outputs: Any = network.apply(params, batch, noise)
        decoded, mean, log_variance = outputs
        error = jnp.square(decoded - batch).sum(-1).mean()
        divergence = 0.5 * (jnp.square(mean) + jnp.exp(log_variance) - 1.0 - log_variance).sum(-1).mean()
        return error + config.kl_coefficient * divergence

    def step(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        params, opt_state = carry
        batch_key, noise_key = prng.split(prng.fold_in(step_key, number))
        batch = vectors[prng.randint(batch_key, (config.batch_size,), 0, vectors.shape[0])]
        noise = prng.normal(noise_key, (config.batch_size, config.latent_size))
        value, grads = jax.value_and_grad(loss)(params, batch, noise)
        updates, opt_state = optimizer.update(grads, opt_state, params)
        return (optax.apply_updates(params, updates), opt_state), value

    @jax.jit
    def train() -> tuple[Any, Array]:
        with prng.pinned():  # Flax's initializers draw
            params = network.init(init_key, vectors[:1], jnp.zeros((1, config.latent_size), jnp.float32))
        (params, _), losses = jax.lax.scan(step, (params, optimizer.init(params)), jnp.arange(config.num_steps))
        return params, losses

    params, losses = train()
    latents, _ = jax.jit(lambda params: network.apply(params, vectors, method=Vae.encode))(params)
    return VaeLevels(params, latents, capacity, generator, config), losses


def _vectors(levels: Level, capacity: Capacity, generator: GeneratorConfig) -> Array:
    return jax.vmap(lambda level: to_vector(level, capacity, generator))(levels)
