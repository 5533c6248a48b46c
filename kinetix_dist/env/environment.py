"""The environment: many worlds at once, each playing the level it was given, again and again.

    prepared = env.prepare(levels)                                  once for a batch of levels
    env_state, obs = env.reset(prepared)
    env_state, obs, reward, done, info = env.step(prepared, env_state, actions)
    policy_input = env.observe(prepared, obs)                       what a policy takes

Signatures follow gymnax with levels as data; every array has a leading world axis, and no key is needed since the
physics is deterministic. One step is

    actions -> controls -> `frame_skip` physics steps -> outcome -> reward -> auto-reset -> observation

A finished episode restarts on the same level in the same step: `reward`, `done` and `info` are of the episode that
ended, the observation is the first one of the next. All methods work inside jit, scan and shard_map (levels prepared
inside it, `check_vma=False`) on any device, and are pure.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import after_fork
from jax2d.effects import Effects
from jax2d.engine import Engine
from jax2d.scene import Array, Capacity, Controls, Touching
from kinetix_dist.env.action_spaces import ACTION_SPACES, ActionDistribution, ActionSpace
from kinetix_dist.env.action_spaces.space import controls_of
from kinetix_dist.env.device_memory import check_fits
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.observations import OBSERVATIONS, Moving, Observation
from kinetix_dist.env.outcome import goal_distance, judge, role_masks
from kinetix_dist.env.records import EnvState, PreparedLevels, StepInfo
from kinetix_dist.env.rewards import REWARDS, Bodies, Reward, Step
from kinetix_dist.level.level import Level, select_first
from kinetix_dist.level.simulation import level_effects
from kinetix_dist.level.walls import empty_level


class Environment:
    """Natively batched environment for the levels of one size. Stateless but for what it compiled."""

    def __init__(self, config: EnvConfig | None = None, *, engine: Engine | None = None) -> None:
        """`engine` replaces the one that the config describes: one made for `effects_of(levels.scene)`, say."""
        self.config = config if config is not None else EnvConfig()
        capacity = self.config.capacity
        if engine is not None and engine.capacity != capacity:
            raise ValueError(f"engine has {engine.capacity}, but size {self.config.size!r} is {capacity}")
        self.observation: Observation = OBSERVATIONS[self.config.observation]
        self.action_space: ActionSpace = ACTION_SPACES[self.config.action_space]
        self.reward: Reward = REWARDS[self.config.reward]
        settings = self.config.physics
        effects = level_effects(capacity, settings)
        self.engine = engine if engine is not None else Engine(capacity, settings=settings, effects=effects)
        self._jit_prepare = jax.jit(self._prepare)
        self._jit_step = jax.jit(self._step)

    @property
    def capacity(self) -> Capacity:
        return self.config.capacity

    @property
    def observation_space(self) -> Any:
        """Shape and type of what a policy sees of one world: the input of a policy with `jax.ShapeDtypeStruct`s."""
        level = jax.tree.map(lambda x: jnp.asarray(x)[None], empty_level(self.capacity))
        obs = jax.eval_shape(lambda: self._first_input(level))
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), obs)

    def _first_input(self, levels: Level) -> Any:
        prepared = self._prepare(levels)
        return self.observe(prepared, prepared.initial_obs)

    @property
    def action_distribution(self) -> ActionDistribution:
        """Distribution of actions. Raises ValueError for an action space in which no policy can act."""
        if self.action_space.distribution is None:
            raise ValueError(f"policies cannot be trained for {self.action_space.name!r} actions")
        return self.action_space.distribution

    def prepare(self, levels: Level) -> PreparedLevels:
        """levels: a batch, [W, ...] on every field, of this environment's size.

        Raises ValueError for levels of another size, for more worlds than the device can observe at once
        (DeviceMemoryError) and, where values are known (outside of jit), for levels that call for effects the engine
        was made without; inside jit `StepInfo.missing_effects` says so.
        """
        after_fork.check()
        self._check_levels(levels)
        self.check_memory(levels.position.shape[0])
        if self.engine.effects != Effects.full(self.capacity):
            self.engine.pack_scene(levels.scene)  # names what is missing, if anything is
        return self._jit_prepare(levels)

    def reset(self, prepared: PreparedLevels) -> tuple[EnvState, Any]:
        """The first state and observation of every world."""
        after_fork.check()
        zeros = jnp.zeros_like(prepared.initial_distance)
        env_state = EnvState(
            packed_state=prepared.initial_packed_state,
            distance=prepared.initial_distance,
            num_steps=zeros.astype(jnp.int32),
            episode_return=zeros,
        )
        return env_state, prepared.initial_obs

    def observe(self, prepared: PreparedLevels, obs: Any) -> Any:
        """The input of a policy, [W, ...], from what `reset` or `step` gave."""
        return self.observation.join(prepared.static_obs, obs)

    def step(
        self, prepared: PreparedLevels, env_state: EnvState, actions: Array
    ) -> tuple[EnvState, Any, Array, Array, StepInfo]:
        """One environment step of every world: (env_state, obs, reward [W] float32, done [W] bool, info).

        actions: see `action_spaces/`; [W, 6] int32 for multi-discrete ones. Raises ValueError for a wrong shape or type
        and, where values are known (outside of jit), for numbers out of range; inside jit those act as "off" and
        are counted in `info.invalid_actions`.
        """
        after_fork.check()
        self.action_space.check(actions, num_worlds=env_state.num_steps.shape[0])
        return self._jit_step(prepared, env_state, actions)

    def bodies_after(self, prepared: PreparedLevels, env_state: EnvState, controls: Controls) -> dict[str, Array]:
        """Position, angle, velocity and angular velocity, [W, n, ...], that one step leads to, before any reset."""
        packed_state, _ = self._physics(prepared, env_state, controls)
        bodies = self.engine.bodies(packed_state)
        return dict(zip(("position", "angle", "velocity", "angular_velocity"), bodies, strict=True))

    def _physics(self, prepared: PreparedLevels, env_state: EnvState, controls: Controls) -> tuple[Any, Touching]:
        return self.engine.step_packed(prepared.packed_scene, env_state.packed_state, controls, self.config.frame_skip)

    def check_memory(self, num_worlds: int) -> None:
        """Raises DeviceMemoryError where the device cannot observe so many worlds at once."""
        if self.observation.working_bytes:
            check_fits(
                num_worlds,
                self.observation.working_bytes,
                what=f"observations {self.config.observation!r} of worlds:",
                advice="play fewer worlds at once",
            )

    def _check_levels(self, levels: Level) -> None:
        """Compares the shapes of a batch of levels with the capacity of this environment."""
        capacity = self.capacity
        shape = np.shape(levels.position)
        if len(shape) != 3:
            raise ValueError(
                f"levels.position has shape {shape}; the environment takes a batch, [worlds, shapes, 2] "
                "(add a leading axis to a single level with jax.tree.map(lambda x: x[None], level))"
            )
        found = {
            "polygons": np.shape(levels.scene.shapes.vertices)[1],
            "circles": np.shape(levels.scene.shapes.radius)[1],
            "joints": np.shape(levels.motor_colour)[1],
            "thrusters": np.shape(levels.thruster_colour)[1],
            "vertices": np.shape(levels.scene.shapes.vertices)[2],
        }
        for name, number in found.items():
            if number != getattr(capacity, name):
                raise ValueError(
                    f"levels have slots for {number} {name}, size {self.config.size!r} for {getattr(capacity, name)}; "
                    "fit the levels to the size or choose another size"
                )

    def pack(self, levels: Level) -> tuple[Any, Any]:
        """(packed scene, packed state) at the start of a batch of levels, as the engine takes them."""
        state = self.engine.initial_state(
            levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity
        )
        return self.engine.pack_scene(levels.scene), self.engine.pack_state(state)

    def _prepare(self, levels: Level) -> PreparedLevels:
        packed_scene, packed_state = self.pack(levels)
        roles = role_masks(levels.shape_role, levels.scene.shapes.active)
        moving = self._at_start(packed_scene, packed_state, num_worlds=levels.shape_role.shape[0])
        return PreparedLevels(
            packed_scene=packed_scene,
            initial_packed_state=packed_state,
            initial_obs=self.observation.dynamic(moving),
            initial_distance=goal_distance(moving.position, roles),
            static_obs=self.observation.static(levels),
            static_reward=self.reward.static(levels),
            bound_heads=self.action_space.bound_heads(levels),
            roles=roles,
            motor_colour=levels.motor_colour,
            motor_auto=levels.motor_auto,
            thruster_colour=levels.thruster_colour,
        )

    def _step(
        self, prepared: PreparedLevels, env_state: EnvState, actions: Array
    ) -> tuple[EnvState, Any, Array, Array, StepInfo]:
        next_state, obs, reward, done, info = self.transition(prepared, env_state, actions)
        # A finished episode restarts on its level.
        next_state, obs = self.restart(prepared, done, next_state, obs)
        return next_state, obs, reward, done, info

    def transition(
        self, prepared: PreparedLevels, env_state: EnvState, actions: Array
    ) -> tuple[EnvState, Any, Array, Array, StepInfo]:
        """`step` without its checks and without restarting: state and observation are those the step led to."""
        # Actions drive motors and thrusters by colour.
        controls, num_invalid = controls_of(
            self.action_space, actions, prepared.motor_colour, prepared.motor_auto, prepared.thruster_colour
        )
        # Physics.
        packed_state, touching = self._physics(prepared, env_state, controls)
        # Outcome, from the state the step led to.
        moving = self._moving(prepared.packed_scene, packed_state, touching.at_end, has_stepped=True)
        num_steps = env_state.num_steps + 1
        outcome = judge(
            touching.during,
            prepared.roles,
            is_finite=_is_finite(moving),
            is_last_step=num_steps >= self.config.max_steps,
        )
        distance = goal_distance(moving.position, prepared.roles)
        # Reward.
        reward, is_invalid = self._reward(
            Step(
                level=prepared.static_reward,
                roles=prepared.roles,
                before=Bodies.of(self.engine.bodies(env_state.packed_state)),
                after=Bodies.of(self.engine.bodies(packed_state)),
                distance_before=env_state.distance,
                distance_after=distance,
                actions=actions,
                controls=controls,
                outcome=outcome,
                num_steps=num_steps,
                failure_penalty=self.config.failure_penalty,
                dense_scale=self.config.dense_reward_scale,
                discount=self.config.shaping_discount,
            )
        )
        episode_return = env_state.episode_return + reward
        info = StepInfo(
            solved=outcome.solved,
            failed=outcome.failed,
            timed_out=outcome.timed_out,
            unstable=outcome.unstable,
            episode_return=episode_return,
            episode_length=num_steps,
            invalid_actions=num_invalid,
            invalid_rewards=is_invalid,
            invalid_controls=touching.invalid_controls,
            invalid_scene=touching.invalid_scene,
            contact_overflow=touching.overflow,
            speed_limited=touching.limited,
            missing_effects=touching.missing,
        )
        next_state = EnvState(
            packed_state=packed_state, distance=distance, num_steps=num_steps, episode_return=episode_return
        )
        return next_state, self.observation.dynamic(moving), reward, outcome.done, info

    def _reward(self, step: Step) -> tuple[Array, Array]:
        """(reward [W] float32, 0 where it is not finite and in unstable worlds; where it was not finite [W] bool)."""
        given = self.reward.reward(step)
        shape, dtype = np.shape(given), jnp.result_type(given)
        if shape != step.num_steps.shape or dtype != jnp.float32:
            raise ValueError(
                f"reward {self.config.reward!r} gives {dtype}{list(shape)}; it has to be float32"
                f"{list(step.num_steps.shape)}, a number for each world"
            )
        reward = jnp.where(step.outcome.unstable, 0.0, given)
        is_invalid = ~jnp.isfinite(reward)
        return jnp.where(is_invalid, 0.0, reward), is_invalid

    def obs_of_start(self, prepared: PreparedLevels, env_state: EnvState) -> Any:
        """Observation, as `reset` gives it, of episodes that start in a state. Contacts are seen after a step."""
        num_worlds = env_state.num_steps.shape[0]
        moving = self._at_start(prepared.packed_scene, env_state.packed_state, num_worlds=num_worlds)
        return self.observation.dynamic(moving)

    def _at_start(self, packed_scene: Any, packed_state: Any, *, num_worlds: int) -> Moving:
        untouched = jnp.zeros((num_worlds, self.capacity.shapes, self.capacity.touch_words), jnp.uint32)
        return self._moving(packed_scene, packed_state, untouched, has_stepped=False)

    def _moving(self, packed_scene: Any, packed_state: Any, touching: Array, *, has_stepped: bool) -> Moving:
        position, angle, velocity, angular_velocity = self.engine.bodies(packed_state)
        return Moving(
            position=position,
            angle=angle,
            velocity=velocity,
            angular_velocity=angular_velocity,
            touching=touching,
            has_stepped=jnp.full(position.shape[0], has_stepped),
        )

    def restart(self, prepared: PreparedLevels, done: Array, env_state: EnvState, obs: Any) -> tuple[EnvState, Any]:
        """First state and observation of a level where `done` [W], else those given."""
        return self.select(prepared, done, self.reset(prepared), (env_state, obs))

    def select(
        self, prepared: PreparedLevels, mask: Array, chosen: tuple[EnvState, Any], other: tuple[EnvState, Any]
    ) -> tuple[EnvState, Any]:
        """State and observation: `chosen` in worlds where mask [W], else `other`."""
        (new, new_obs), (old, old_obs) = chosen, other
        return EnvState(
            packed_state=_select_worlds_last(mask, new.packed_state, old.packed_state),
            distance=select_first(mask, new.distance, old.distance),
            num_steps=select_first(mask, new.num_steps, old.num_steps),
            episode_return=select_first(mask, new.episode_return, old.episode_return),
        ), select_first(mask, new_obs, old_obs)


def _is_finite(moving: Moving) -> Array:
    """[W] bool: all that the physics tells of a world is a finite number."""
    numbers = (moving.position, moving.angle[..., None], moving.velocity, moving.angular_velocity[..., None])
    return jnp.isfinite(jnp.concatenate(numbers, axis=-1)).all(axis=(1, 2))


def _select_worlds_last(mask: Array, chosen: Any, other: Any) -> Any:
    """`chosen` in worlds where mask [W], else `other`; leaves [..., W], as the engine packs them."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), chosen, other)
