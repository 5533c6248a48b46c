"""A teacher: a policy that builds levels action by action (`LevelBuilder`) and learns from what came of each.

build   parameters, a key a level      -> levels, and the trajectory of their construction
learn   that trajectory, a reward each -> the next state: PPO, the reward comes with the last action, undiscounted
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp

from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.checkpoint import Checkpoint, select_arrays, unflatten_arrays
from kinetix_dist.curator.agents import AgentPpo, Agents
from kinetix_dist.curator.config import CurriculumConfig, PairedConfig
from kinetix_dist.env.action_spaces.masked_categorical import MaskedCategorical
from kinetix_dist.level.construction import (
    HEADS,
    NUM_DRAWS,
    Construction,
    allowed,
    apply_action,
    begin,
    check_construction,
    finish,
    head_sizes,
    num_order_draws,
    num_steps,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level
from kinetix_dist.messages import StaticInput, Trajectory
from kinetix_dist.models.teacher import NUM_NOISE, TeacherObs, TeacherPolicy, construction_features


class LevelBuilder:
    """Builds levels of one capacity by given parameters. Raises ValueError where levels cannot be built."""

    def __init__(self, capacity: Capacity, generator: GeneratorConfig, config: PairedConfig) -> None:
        check_construction(capacity, generator)
        self._capacity = capacity
        self._generator = generator
        self.distribution = MaskedCategorical(head_sizes=head_sizes(capacity))
        self.policy = TeacherPolicy(config.hidden_size, config.hidden_layers, self.distribution.head_sizes)

    def first_obs(self) -> TeacherObs:
        """Observation of one level before anything is built; works in `jax.eval_shape`."""
        return self._observe(self._begin(1), jnp.int32(0), jnp.zeros((1, NUM_NOISE), jnp.float32))

    def build(self, params: Any, keys: Array) -> tuple[Level, Trajectory]:
        """Levels [B, ...] and how they were built, [T, B, ...], rewards left at 0. Consumes the keys [B].

        A level depends on its own key and the parameters only.
        """
        num_levels, last = keys.shape[0], num_steps(self._capacity) - 1
        first_key, step_key = jnp.moveaxis(jax.vmap(prng.split)(keys), 1, 0)
        num_order = num_order_draws(self._capacity)
        noise, order = jnp.split(_uniforms(first_key, 0, NUM_NOISE + num_order), [NUM_NOISE], axis=1)

        def step(building: Construction, number: Array) -> tuple[Construction, Trajectory]:
            obs = self._observe(building, number, noise)
            outputs, value = cast("tuple[tuple[Array, ...], Array]", self.policy.apply(params, obs))
            draws = _uniforms(step_key, number, len(HEADS) + NUM_DRAWS)
            actions, log_prob = self.distribution.sample(outputs, draws[:, : len(HEADS)])
            taken = Trajectory(
                dynamic_obs=obs,
                actions=actions.astype(self.distribution.stored_dtype),
                log_probs=log_prob,
                values=value,
                rewards=jnp.zeros_like(value),
                done_after=jnp.broadcast_to(number == last, value.shape),
            )
            act = jax.vmap(apply_action, in_axes=(0, None, 0, 0, None, None))
            return act(building, number, actions, draws[:, len(HEADS) :], self._capacity, self._generator), taken

        building, trajectory = jax.lax.scan(step, self._begin(num_levels), jnp.arange(last + 1))
        levels = jax.vmap(lambda one, draws: finish(one, draws, self._capacity))(building, order)
        return levels, trajectory

    def _begin(self, num_levels: int) -> Construction:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_levels, *x.shape)), begin(self._capacity))

    def _observe(self, building: Construction, number: Array, noise: Array) -> TeacherObs:
        features = jax.vmap(construction_features, in_axes=(0, None, 0, None))
        masks = jax.vmap(allowed, in_axes=(0, None, None, None))
        return TeacherObs(
            features=features(building, number, noise, self._capacity),
            allowed=masks(building, number, self._capacity, self._generator),
        )


class Teacher(LevelBuilder):
    """A builder that learns."""

    def __init__(self, capacity: Capacity, generator: GeneratorConfig, config: PairedConfig, agents: Agents) -> None:
        super().__init__(capacity, generator, config)
        ppo = AgentPpo(
            learning_rate=config.learning_rate,
            epochs=config.epochs,
            clip=config.clip,
            entropy_coefficient=config.entropy_coefficient,
            minibatches=1,
            discount=1.0,  # levels are short games with one reward at their end
            trace=0.95,
            value_clip=False,
        )
        self._agent = agents.teacher(self.policy, self.distribution, jax.eval_shape(self.first_obs), ppo)

    def init(self) -> Any:
        return self._agent.init()

    def learn(self, state: Any, trajectory: Trajectory, rewards: Array) -> tuple[Any, dict[str, Array]]:
        """(next state, metrics) from levels that were built, [T, B, ...], and the reward of each [B]."""
        trajectory = dataclasses.replace(trajectory, rewards=trajectory.rewards.at[-1].set(rewards))
        return self._agent.learn(state, StaticInput(obs=None), trajectory, jnp.zeros_like(rewards))


def _uniforms(keys: Array, number: Array | int, count: int) -> Array:
    """[B, count]"""
    return jax.vmap(lambda key: prng.uniform(prng.fold_in(key, number), (count,)))(keys)


PARAMS_PREFIX = "curriculum/teacher/params"  # where a checkpoint's arrays keep the parameters of the teacher


@dataclasses.dataclass(frozen=True)
class TeacherLevels:
    """Levels that a teacher builds with given parameters; a `LevelGenerator`."""

    builder: LevelBuilder
    params: Any

    def generate(self, key: Array, num_levels: int) -> Level:
        return self.builder.build(self.params, prng.split(key, num_levels))[0]


def teacher_levels(checkpoint: Checkpoint, config: CurriculumConfig, capacity: Capacity) -> TeacherLevels:
    """Generator of the teacher in a checkpoint of a run with this curriculum and capacity.

    Raises ValueError for a run of another curriculum, and `ArrayMismatchError` for parameters of another network.
    """
    if config.name != "paired":
        raise ValueError(f"{checkpoint.path} is of curriculum {config.name!r}; only 'paired' has a teacher")
    builder = LevelBuilder(capacity, config.generator, config.paired)
    template = jax.eval_shape(lambda key: builder.policy.init(key, builder.first_obs()), prng.key(0))
    params = unflatten_arrays(template, select_arrays(checkpoint.arrays, PARAMS_PREFIX))
    return TeacherLevels(builder, jax.tree.map(jnp.asarray, params))
