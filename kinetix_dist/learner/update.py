"""One learner update: advantages, then epochs of shuffled minibatches of clipped PPO, on all devices at once.

    update = make_update(policy, env.observation, env.action_distribution, PpoConfig(), data_mesh())
    learner_state, metrics = update(learner_state, static, trajectory, last_value)

    trajectory, sharded by world --> advantages --> for each epoch: shuffle, statistics of advantages (psum)
                                                    for each minibatch: gradient of this device's samples
                                                                        --> one psum of one flat vector --> Adam

One device or many make the same update, up to the order of floating-point sums: worlds form a fixed number of
virtual shards, each shuffles its own samples with its own key, and minibatch k is the union of the k-th parts of all
virtual shards, wherever these live. Where their number is no multiple of that of the devices, some shards are there
twice and are left out of every sum once (`division.py`). A gradient that is not finite after the sum is so on every
device: all skip that step together and count it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, PartitionSpec

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.action_spaces import ActionDistribution
from kinetix_dist.env.observations import Observation
from kinetix_dist.learner import noise_scale
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.gae import gae
from kinetix_dist.learner.ppo_loss import LOSS_METRICS, Samples, ppo_terms, total_loss
from kinetix_dist.learner.sharding import DATA_AXIS, on_devices
from kinetix_dist.learner.state import LearnerState
from kinetix_dist.learner.step_size import Sizes, average, guarded, sizes
from kinetix_dist.messages import StaticInput, Trajectory
from kinetix_dist.models.gru import has_memory
from kinetix_dist.models.kernels.cuda_kernel import CUSTOM_CALLS
from kinetix_dist.models.kernels.support import traced_for
from kinetix_dist.models.linear import stored
from kinetix_dist.program_cache import ProgramKey, exported_on_mesh, is_cacheable

METRICS = (*LOSS_METRICS, "grad_norm", "explained_variance", "skipped_steps", "learning_rate")

# How what an update takes lies on a mesh: learner state, static, trajectory, last value.
IN_SPECS = PartitionSpec(), PartitionSpec(DATA_AXIS), PartitionSpec(None, DATA_AXIS), PartitionSpec(DATA_AXIS)
OUT_SPECS = PartitionSpec(), PartitionSpec()  # and what it gives: learner state, metrics

CACHE = "updates"  # folder in the program cache
Update = Callable[[LearnerState, StaticInput, Trajectory, Array], tuple[LearnerState, dict[str, Array]]]


class JitUpdate(Protocol):
    """An `Update` that is compiled when it is called, or by `lower(...).compile()`."""

    def __call__(
        self, state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array, /
    ) -> tuple[LearnerState, dict[str, Array]]: ...

    def lower(
        self, state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array, /
    ) -> jax.stages.Lowered: ...


@dataclasses.dataclass(frozen=True)
class _Program:
    """Settings that an update is compiled for."""

    policy: nn.Module
    observation: Observation
    distribution: ActionDistribution
    config: PpoConfig
    division: Division  # of the virtual shards, or of blocks of them

    @property
    def shards_per_slot(self) -> int:
        return self.config.virtual_shards // self.division.num_parts

    @property
    def is_recurrent(self) -> bool:
        """Then minibatches are of whole worlds, [T, worlds] samples step by step, and memory runs through them."""
        return has_memory(self.policy)


@functools.lru_cache(maxsize=8)
def make_update(
    policy: nn.Module,
    observation: Observation,
    distribution: ActionDistribution,
    config: PpoConfig,
    mesh: Mesh,
    *,
    division: Division | None = None,
) -> JitUpdate:
    """A compiled update(learner_state, static, trajectory, last_value) -> (learner_state, metrics), once a process for
    equal arguments, which are hashable.

    observation, distribution: those of the environment; `policy` takes the one and gives the outputs of the other.
    division: of blocks of virtual shards over the devices, by default of single ones; a divisor of their number.
    learner_state: replicated over `mesh`. static [W, ...], trajectory [T, W, ...] and last_value [W]: sharded by
    world (`sharding.shard_worlds`), in all slots of the division (`Division.spread`). metrics: METRICS, replicated
    float32 scalars, means over applied gradient steps (NaN when all were skipped) except explained_variance (of the
    values in the trajectory), skipped_steps and the learning_rate of the update.
    """

    division = division or Division(config.virtual_shards, mesh.devices.size)
    program = _Program(policy, observation, distribution, config, division)

    def local_update(
        state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array
    ) -> tuple[LearnerState, dict[str, Array]]:
        return _update(program, state, static, trajectory, last_value)

    # Gradients are summed by hand, all leaves in one psum.
    on_mesh = on_devices(local_update, mesh, in_specs=IN_SPECS, out_specs=OUT_SPECS)

    def update(
        state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array
    ) -> tuple[LearnerState, dict[str, Array]]:
        num_steps, num_rows = trajectory.rewards.shape
        num_worlds = _num_worlds(division, num_rows)
        config.check_batch(num_steps=num_steps, num_worlds=num_worlds, whole_worlds=program.is_recurrent)
        return on_mesh(state, static, trajectory, last_value)

    return jax.jit(update)


@functools.lru_cache(maxsize=8)
def exported_update(
    policy: nn.Module,
    observation: Observation,
    distribution: ActionDistribution,
    config: PpoConfig,
    mesh: Mesh,
    *,
    division: Division | None = None,
) -> Update:
    """Returns `make_update`, from the program cache where a process has traced it for equal arguments and arrays.

    An update with a part of a class from outside of this project is traced in every process: that code may change.
    """
    update = make_update(policy, observation, distribution, config, mesh, division=division)
    parts = policy, observation, distribution
    if not is_cacheable(*parts):
        return update
    key = ProgramKey(
        kind=CACHE,
        module=__name__,
        parts=parts,
        depends_on=(config, division),
        at_trace=traced_for,
        custom_calls=CUSTOM_CALLS,
    )
    return exported_on_mesh(update, key, mesh, in_specs=IN_SPECS, out_specs=OUT_SPECS)


def advantages_of(trajectory: Trajectory, last_value: Array, config: PpoConfig) -> Array:
    """[T, W] float32, by which a policy is updated."""
    rewards, values, done_after = trajectory.rewards, trajectory.values, trajectory.done_after
    if trajectory.timed_out is not None:
        # What followed was never seen: the value of the state before stands for it.
        rewards = rewards + config.discount * jnp.where(trajectory.timed_out, values, 0.0)
    return gae(rewards, values, done_after, last_value, discount=config.discount, trace=config.trace)


def _update(
    program: _Program, state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array
) -> tuple[LearnerState, dict[str, Array]]:
    """The update as one device sees it; arrays hold its own worlds."""
    config, division = program.config, program.division
    num_steps, num_worlds = trajectory.rewards.shape
    num_samples = num_steps * _num_worlds(division, num_worlds * division.num_devices)  # of all devices
    advantages = advantages_of(trajectory, last_value, config)
    targets = advantages + trajectory.values
    # [T, W, ...] -> [T W, ...]: sample t W + w is step t of world w.
    flat = jax.tree.map(lambda x: x.reshape(num_steps * num_worlds, *x.shape[2:]), (trajectory, advantages, targets))
    minibatch_size = num_samples // config.minibatches  # of all devices
    is_counted = _counted_of_minibatch(program, num_steps, num_worlds)
    # Worlds begin an update with an episode, or with a memory: that of their first step.
    is_first = jnp.roll(trajectory.done_after, 1, axis=0).at[0].set(static.memory is None).reshape(-1)
    flat_params, unravel = ravel_pytree(state.params)
    key = prng.fold_in(prng.wrap_key_data(state.key), state.num_updates)
    now = sizes(config, state)

    def epoch(carry: tuple[Array, Any], number: Array) -> tuple[tuple[Array, Any], Array]:
        index = _shuffled(prng.fold_in(key, number), num_steps, num_worlds, program)
        offset, scale = _advantage_statistics(advantages.reshape(-1)[index], is_counted, minibatch_size, config)
        return jax.lax.scan(minibatch, carry, (index, offset, scale))

    def share(params: Any, index: Array, offset: Array, scale: Array) -> tuple[Array, Array]:
        """Share of these samples in the gradient of the mean loss and in the means of LOSS_METRICS."""
        steps, minibatch_advantages, minibatch_targets = jax.tree.map(lambda x: x[index], flat)
        fixed = jax.tree.map(lambda x: x[index % num_worlds], dataclasses.replace(static, memory=None))
        samples = Samples(
            actions=steps.actions,
            old_log_probs=steps.log_probs,
            old_values=steps.values,
            advantages=(minibatch_advantages - offset) * scale,
            targets=minibatch_targets,
            is_counted=is_counted,
            bound_heads=fixed.bound_heads,
        )
        obs = program.observation.join(fixed.obs, steps.dynamic_obs)
        memory = {}
        if program.is_recurrent:
            memory = {"is_first": is_first[index].reshape(num_steps, -1)}
            if static.memory is not None:
                memory["memory"] = static.memory[index[: memory["is_first"].shape[1]] % num_worlds]
        grads, terms = _gradient(program, now, params, obs, samples, minibatch_size, memory)
        return ravel_pytree(grads)[0], terms

    def minibatch(carry: tuple[Array, Any], at: tuple[Array, Array, Array]) -> tuple[tuple[Array, Any], Array]:
        flat_params, opt_state = carry
        index, *statistics = at
        params = unravel(flat_params)
        parts = [index]
        if config.noise_scale:
            num_rows = num_steps if program.is_recurrent else 1
            parts = noise_scale.parts_here(index, division.num_devices, num_rows=num_rows)
        shares = [share(params, part, *statistics) for part in parts]
        grad, terms = (functools.reduce(jnp.add, values) for values in zip(*shares, strict=True))
        if config.noise_scale:
            counts = [part.size if is_counted is None else is_counted.sum() for part in parts]
            squares = [
                noise_scale.part_square(grad, count, minibatch_size)
                for count, (grad, _) in zip(counts, shares, strict=True)
            ]
            terms = jnp.append(terms, sum(squares))
        # The only communication of a gradient step: gradient and metrics of all devices in one vector.
        # Stored, else on one device the norm is a sum over a concatenation, ten times as slow as its traffic.
        summed = stored(jax.lax.psum(jnp.concatenate([grad, terms]), DATA_AXIS))
        grad, terms = jnp.split(summed, [flat_params.size])
        return _apply(config, now, flat_params, opt_state, grad, terms)

    (flat_params, opt_state), rows = jax.lax.scan(
        epoch, (flat_params, state.opt_state), jnp.arange(config.epochs, dtype=jnp.uint32)
    )
    metrics, num_applied = _summarise(config, rows.reshape(-1, rows.shape[-1]))
    if config.noise_scale:
        squares = metrics.pop("part_square"), metrics.pop("square")
        metrics |= noise_scale.noise_metrics(*squares, noise_scale.num_parts(division.num_devices), minibatch_size)
    metrics["explained_variance"] = _explained_variance(
        targets, advantages, _counted(program, num_samples_here=num_worlds), num_samples
    )
    metrics["learning_rate"] = config.learning_rate * now.rate
    params = unravel(flat_params)
    state = LearnerState(
        params=params,
        average=average(config, state, params),
        opt_state=opt_state,
        key=state.key,
        num_updates=state.num_updates + 1,
        num_gradient_steps=state.num_gradient_steps + num_applied,
        env_steps=state.env_steps,
        rate_factor=guarded(config, state, metrics["approx_kl"]),
    )
    return state, metrics


def _num_worlds(division: Division, num_rows: int) -> int:
    """Number of worlds of all devices, each once, of those that lie in all slots."""
    return num_rows // (division.num_devices * division.slots) * division.num_parts


def _counted(program: _Program, *, num_samples_here: int) -> Array | None:
    """[samples] bool, the same number for each slot of this device: false where a part is there once more.

    None where all count.
    """
    division = program.division
    if division.is_even:
        return None
    is_counted = jnp.asarray(division.is_counted)[jax.lax.axis_index(DATA_AXIS)]
    return jnp.repeat(is_counted, num_samples_here // division.slots)


def _counted_of_minibatch(program: _Program, num_steps: int, num_worlds: int) -> Array | None:
    """The same for the samples of a minibatch, in the order of `_shuffled`."""
    minibatches = program.config.minibatches
    if not program.is_recurrent:
        return _counted(program, num_samples_here=num_steps * num_worlds // minibatches)
    of_step = _counted(program, num_samples_here=num_worlds // minibatches)
    return None if of_step is None else jnp.tile(of_step, num_steps)


def _sum(x: Array, is_counted: Array | None, axis: int | None = None) -> Array:
    """Over all devices, of what counts."""
    return jax.lax.psum(jnp.sum(x if is_counted is None else jnp.where(is_counted, x, 0.0), axis=axis), DATA_AXIS)


def _shuffled(key: Array, num_steps: int, num_worlds: int, program: _Program) -> Array:
    """Sample numbers of this device's part of each minibatch of an epoch: [minibatches, samples] int32.

    Of a recurrent policy, whole worlds are shuffled: samples [T, worlds], step by step.
    """
    config, block = program.config, program.shards_per_slot
    blocks = jnp.asarray(program.division.parts)[jax.lax.axis_index(DATA_AXIS)]
    numbers = (blocks[:, None] * block + jnp.arange(block)).reshape(-1)  # of the shards on this device
    num_shards = numbers.size
    worlds_a_shard = num_worlds // num_shards

    def shard_worlds(shard: Array, number: Array) -> Array:
        bits = prng.bits(prng.fold_in(key, number), (worlds_a_shard,))
        return shard * worlds_a_shard + jnp.argsort(bits).astype(jnp.int32)

    if program.is_recurrent:
        worlds = jax.vmap(shard_worlds)(jnp.arange(num_shards), numbers)
        worlds = jnp.moveaxis(worlds.reshape(num_shards, config.minibatches, -1), 1, 0)
        steps = num_worlds * jnp.arange(num_steps, dtype=jnp.int32)
        return (steps[:, None] + worlds.reshape(config.minibatches, 1, -1)).reshape(config.minibatches, -1)

    def shard_samples(shard: Array, number: Array) -> Array:
        bits = prng.bits(prng.fold_in(key, number), (num_steps * worlds_a_shard,))
        sample = jnp.argsort(bits)  # equal bits keep their order: still the same on every device
        step, world = sample // worlds_a_shard, sample % worlds_a_shard
        return (step * num_worlds + shard * worlds_a_shard + world).astype(jnp.int32)

    samples = jax.vmap(shard_samples)(jnp.arange(num_shards), numbers)
    parts = samples.reshape(num_shards, config.minibatches, -1)
    return jnp.moveaxis(parts, 1, 0).reshape(config.minibatches, -1)


def _advantage_statistics(
    advantages: Array, is_counted: Array | None, minibatch_size: int, config: PpoConfig
) -> tuple[Array, Array]:
    """Shift and scale of the advantages of each minibatch, over all devices: two [minibatches]."""
    if not config.normalise_advantages:
        return jnp.zeros(config.minibatches, jnp.float32), jnp.ones(config.minibatches, jnp.float32)
    mean = _sum(advantages, is_counted, axis=1) / minibatch_size
    squares = jnp.square(advantages - mean[:, None])
    std = jnp.sqrt(_sum(squares, is_counted, axis=1) / minibatch_size)
    return mean, 1.0 / (std + 1e-8)  # 1e-8: equal advantages become zeros


def minibatch_loss(
    program: _Program, now: Sizes, obs: Any, samples: Samples, minibatch_size: int, memory: dict[str, Array]
) -> Callable[[Any], tuple[Array, tuple[Array, Array]]]:
    """Loss as a function of the parameters: this device's share of the mean loss, (shares of LOSS_METRICS, log-probs).

    memory: further input of a recurrent policy, see models/gru.py.
    """
    config = program.config
    counted = {} if samples.bound_heads is None else {"bound": samples.bound_heads}

    def loss(params: Any) -> tuple[Array, tuple[Array, Array]]:
        outputs, values = program.policy.apply(params, obs, **memory)
        log_probs, entropies = program.distribution.log_prob_and_entropy(outputs, samples.actions, **counted)
        value_clip = now.clip if config.value_clip else None
        terms = ppo_terms(log_probs, entropies, values, samples, clip=now.clip, value_clip=value_clip)
        means = terms / minibatch_size
        weights = {"value_coefficient": config.value_coefficient, "entropy_coefficient": now.entropy_coefficient}
        return total_loss(means, **weights), (means, log_probs)

    return loss


def _gradient(
    program: _Program,
    now: Sizes,
    params: Any,
    obs: Any,
    samples: Samples,
    minibatch_size: int,
    memory: dict[str, Array],
) -> tuple[Any, Array]:
    """Share of this device in the gradient of the mean loss and in the means of LOSS_METRICS."""
    loss = minibatch_loss(program, now, obs, samples, minibatch_size, memory)
    gradient, (means, _) = jax.grad(loss, has_aux=True)(params)
    return gradient, means


def _apply(
    config: PpoConfig, now: Sizes, flat_params: Array, opt_state: Any, grad: Array, terms: Array
) -> tuple[tuple[Array, Any], Array]:
    """Clips by norm and steps, unless the gradient is not finite; one row of metrics: `_columns`, applied."""
    square = jnp.sum(jnp.square(grad))
    norm = jnp.sqrt(square)
    is_finite = jnp.isfinite(norm)
    clipped = grad * jnp.minimum(1.0, config.max_grad_norm / jnp.maximum(norm, 1e-12))
    step, new_opt_state = config.optimizer().update(clipped, opt_state, flat_params)

    step = step * now.rate  # steps of Adam are as long as its learning rate

    def keep_if_skipped(new: Array, old: Array) -> Array:
        return jnp.where(is_finite, new, old)

    flat_params = keep_if_skipped(flat_params + step, flat_params)
    opt_state = jax.tree.map(keep_if_skipped, new_opt_state, opt_state)
    squares = [square[None]] if config.noise_scale else []
    row = jnp.where(is_finite, jnp.concatenate([terms, *squares, norm[None], jnp.ones(1, jnp.float32)]), 0.0)
    return (flat_params, opt_state), row


def _columns(config: PpoConfig) -> tuple[str, ...]:
    """Names of the metrics of a gradient step."""
    squares = ("part_square", "square") if config.noise_scale else ()  # `small` and `whole` of `noise_scale.py`
    return (*LOSS_METRICS, *squares, "grad_norm")


def _summarise(config: PpoConfig, rows: Array) -> tuple[dict[str, Array], Array]:
    """Means over the applied gradient steps, and how many these were."""
    num_applied = jnp.sum(rows[:, -1])
    means = jnp.sum(rows[:, :-1], axis=0) / num_applied
    metrics = dict(zip(_columns(config), means, strict=True))
    metrics["skipped_steps"] = rows.shape[0] - num_applied
    return metrics, num_applied.astype(jnp.int32)


def _explained_variance(targets: Array, advantages: Array, is_counted: Array | None, num_samples: int) -> Array:
    """1 - variance of what the value missed / variance of its target, over all devices."""

    def variance(x: Array) -> Array:
        mean = _sum(x, is_counted) / num_samples
        return _sum(jnp.square(x - mean), is_counted) / num_samples

    return 1.0 - variance(advantages) / jnp.maximum(variance(targets), 1e-8)
