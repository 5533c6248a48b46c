"""Methods: how the next chunk is made while the one before is executed.

    plain            a sample of the policy, whatever the old plan was: synchronous and naive execution
    bidirectional    of N samples the one nearest to the old plan, and, with a weaker policy, nearest to good samples
                     and farthest from weak ones: bidirectional decoding (Liu et al. 2024, arXiv 2408.17355), with the
                     weights of RTC's soft mask as in the public benchmark of RTC
    rtc              guided inpainting, see guidance.py
    training_time    the first `delay` actions are given, see flow_matching.py; the policy was trained for it

A method is a frozen dataclass with `plan`; one of your own needs no more to be played by `execution.py`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.delay.chunk_policy import ChunkPolicy
from kinetix_dist.delay.flow_matching import integrate, integrate_after, prefix_mask
from kinetix_dist.delay.guidance import MAX_GUIDANCE, guided, soft_weights


class Plan(NamedTuple):
    """Rest of the chunk before, of W worlds. Numbers may be traced."""

    chunk: Array  # [W, H, A] in -1..1; the first action is due now
    delay: Array | int  # so many of its actions are executed until the next chunk is there
    known: Array | int  # it has so many actions; zeros behind


class Seen(NamedTuple):
    """Inputs of a method, of W worlds."""

    obs: Any  # joined, [W, ...], from when the computation begins
    bound: Array  # [W, A] bool
    keys: Array  # [W], used up


class Params(NamedTuple):
    """Parameters of a policy, and of a weaker one such as an earlier checkpoint where a method compares with it."""

    strong: Any
    weak: Any | None = None


class Method(Protocol):
    """Hashable: static under jit."""

    def plan(self, policy: ChunkPolicy, params: Params, seen: Seen, old: Plan) -> Array:
        """The next chunk [W, H, A] in -1..1, aligned with `old.chunk`."""


@dataclasses.dataclass(frozen=True)
class Plain:
    """Each chunk by itself."""

    def plan(self, policy: ChunkPolicy, params: Params, seen: Seen, old: Plan | None) -> Array:
        del old
        return sampled(policy, params, seen)


def sampled(policy: ChunkPolicy, params: Params, seen: Seen) -> Array:
    """A chunk that depends on no other."""
    flow = policy.flow(params.strong, seen.obs, seen.bound)
    return jnp.clip(integrate(flow, policy.noise(seen.keys, seen.bound), policy.num_steps), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Rtc:
    """Guided inpainting."""

    max_guidance: float = MAX_GUIDANCE

    def plan(self, policy: ChunkPolicy, params: Params, seen: Seen, old: Plan) -> Array:
        weights = soft_weights(old.delay, old.known, policy.horizon)[:, None] * seen.bound[:, None]
        flow = guided(policy.flow(params.strong, seen.obs, seen.bound), old.chunk, weights, self.max_guidance)
        return jnp.clip(integrate(flow, policy.noise(seen.keys, seen.bound), policy.num_steps), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class TrainingTimeRtc:
    """The prefix is given. The policy was trained with prefixes of up to `FlowConfig.max_delay`."""

    def plan(self, policy: ChunkPolicy, params: Params, seen: Seen, old: Plan) -> Array:
        flow, noise = policy.flow(params.strong, seen.obs, seen.bound), policy.noise(seen.keys, seen.bound)
        is_given = prefix_mask(jnp.asarray(old.delay), policy.horizon)
        return jnp.clip(integrate_after(flow, noise, policy.num_steps, old.chunk, is_given), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Bidirectional:
    """Best of `num_samples`. `num_kept`: size of the sets of good and of weak samples of the forward contrast."""

    num_samples: int = 16
    num_kept: int = 3

    def plan(self, policy: ChunkPolicy, params: Params, seen: Seen, old: Plan) -> Array:
        weights = soft_weights(old.delay, old.known, policy.horizon)
        strong = self._samples(policy, params.strong, seen)
        loss = backward_loss(strong, old.chunk, weights)
        if params.weak is not None:
            weak = self._samples(policy, params.weak, seen)
            good = _nearest(strong, loss, self.num_kept)
            bad = _nearest(weak, backward_loss(weak, old.chunk, weights), self.num_kept)
            loss += forward_loss(strong, good, bad) / self.num_samples
        return _nearest(strong, loss, 1)[0]

    def _samples(self, policy: ChunkPolicy, params: Any, seen: Seen) -> Array:
        """[N, W, H, A]. Observations are embedded once."""
        embedding = policy.network.apply(params, seen.obs, method="encode")

        def sample(number: Array) -> Array:
            keys = jax.vmap(prng.fold_in, (0, None))(seen.keys, number)
            flow = policy.flow_of(params, embedding, seen.bound)
            return integrate(flow, policy.noise(keys, seen.bound), policy.num_steps)

        return jnp.clip(jax.vmap(sample)(jnp.arange(self.num_samples, dtype=jnp.uint32)), -1.0, 1.0)


def backward_loss(samples: Array, old: Array, weights: Array) -> Array:
    """[N, W]: weighted distance of samples [N, W, H, A] to the old plan, action by action."""
    return jnp.sum(weights * jnp.linalg.norm(samples - old, axis=-1), axis=-1)


def forward_loss(samples: Array, good: Array, bad: Array) -> Array:
    """[N, W]: distances of samples to all good ones [k, W, H, A], less those to all bad ones, summed over actions."""

    def distance(others: Array) -> Array:
        return jnp.sum(jnp.linalg.norm(samples[:, None] - others, axis=-1), axis=(1, 3))

    return distance(good) - distance(bad)


def _nearest(samples: Array, loss: Array, count: int) -> Array:
    """[count, W, H, A] of least loss."""
    _, index = jax.lax.top_k(-loss.T, count)
    return jnp.take_along_axis(samples, index.T[:, :, None, None], axis=0)
