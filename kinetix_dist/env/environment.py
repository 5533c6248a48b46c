"""The environment: many worlds at once, each playing the level it was given, again and again.

    prepared = env.prepare(levels)                                  once for a batch of levels
    env_state, obs = env.reset(prepared)
    env_state, obs, reward, done, info = env.step(prepared, env_state, actions)
    policy_input = observe(prepared.static_obs, obs)                the full entity observation

Signatures follow gymnax with levels as data; every array has a leading world axis, and no key is needed since the
physics is deterministic. One step is

    actions -> controls -> `frame_skip` physics steps (`stepper.py`) -> outcome -> reward -> auto-reset -> observation

A finished episode restarts on the same level in the same step: `reward`, `done` and `info` are of the episode that
ended, the observation is the first one of the next. All methods work inside jit, scan and shard_map (worlds sharded;
`world_partition_specs` says how) on any device, and are pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from jax2d.effects import Effects
from jax2d.engine import Engine
from jax2d.scene import Array, Capacity, Controls, Touching
from jax2d.settings import Settings, preset
from kinetix_dist.env.actions import controls_of
from kinetix_dist.env.autoreset import select_worlds_first
from kinetix_dist.env.observations.entities import DynamicObs, StaticObs, dynamic_obs, static_obs
from kinetix_dist.env.reward import Outcome, RoleMasks, goal_distance, judge, reward_of, role_masks
from kinetix_dist.env.spaces import ACTION_SPACES, ActionSpace
from kinetix_dist.env.stepper import GroupedScene, GroupedState, GroupedStepper, Stepper
from kinetix_dist.level.level import SIZES, Level

# Fields whose leaves are packed engine arrays, [field, W]: the world axis is last instead of first.
PACKED_FIELDS = frozenset({"packed_scene", "packed_state", "initial_packed_state"})


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Defaults are those of the paper."""

    size: str = "s"  # "s", "m" or "l", see `level.SIZES`
    physics: Settings = preset("standard")  # how a physics step is solved, all numbers of it
    frame_skip: int = 2  # physics steps of 1/60 s in one environment step
    max_steps: int = 256  # environment steps after which an episode times out
    dense_reward_scale: float = 0.1  # kappa, reward for each metre that green comes closer to blue
    action_space: str = "multi_discrete"  # or "continuous" or "discrete", see `env.spaces`
    effect_groups: int = 0  # groups of worlds with engines of their own, see `env.stepper`; 0: one full engine for all

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise ValueError(f"EnvConfig.size is {self.size!r}; sizes are {', '.join(SIZES)}")
        if self.action_space not in ACTION_SPACES:
            raise ValueError(
                f"EnvConfig.action_space is {self.action_space!r}; action spaces are {', '.join(ACTION_SPACES)}"
            )
        for name in ("frame_skip", "max_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"EnvConfig.{name} is {getattr(self, name)}; it must be 1 or more")
        if self.physics.solver_batch_size > 1 or self.physics.published_details:
            raise ValueError(
                f"EnvConfig.physics has solver_batch_size {self.physics.solver_batch_size}, published_details "
                f"{self.physics.published_details}; environments are stepped by the kernel: use 1 and ()"
            )
        if self.effect_groups < 0:
            raise ValueError(f"EnvConfig.effect_groups is {self.effect_groups}; it must be 0 or more")
        if not (np.isfinite(self.dense_reward_scale) and self.dense_reward_scale >= 0):
            raise ValueError(f"EnvConfig.dense_reward_scale is {self.dense_reward_scale}; it must be 0 or more")

    @property
    def capacity(self) -> Capacity:
        return SIZES[self.size]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PreparedLevels:
    """All that a batch of levels contributes to a step. Only selected from, never changed, by reset and step."""

    packed_scene: Any  # jax2d packed scene, [field, W], or a GroupedScene
    initial_packed_state: Any  # jax2d packed state, [field, W], or a GroupedState
    initial_obs: DynamicObs  # [W, ...]
    initial_distance: Array  # [W] m, of green and blue
    static_obs: StaticObs  # [W, ...]
    roles: RoleMasks  # [W, ...]
    motor_colour: Array  # [W, J] int32
    motor_auto: Array  # [W, J] bool
    thruster_colour: Array  # [W, T] int32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvState:
    """How a batch of episodes stands."""

    packed_state: Any  # jax2d packed state, [field, W], or a GroupedState
    distance: Array  # [W] m, of green and blue now
    num_steps: Array  # [W] int32, environment steps taken in this episode
    episode_return: Array  # [W] float32, undiscounted sum of rewards of this episode


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class StepInfo:
    """What else is known of a step. Outcomes are True only in the step that ends an episode, one of them at most."""

    solved: Array  # [W] bool, green touched blue
    failed: Array  # [W] bool, green touched red
    timed_out: Array  # [W] bool, `max_steps` passed
    unstable: Array  # [W] bool, the physics gave a number that is not finite; reward 0
    episode_return: Array  # [W] float32, of the episode so far, this step included (the final value where done)
    episode_length: Array  # [W] int32, likewise
    invalid_actions: Array  # [W] int32, numbers of this step's action that were out of range and acted as "off"
    invalid_controls: Array  # [W] int32, controls that the engine found out of range or NaN
    invalid_scene: Array  # [W] int32, joints, thrusters and polygons of the level that make no sense to the engine
    contact_overflow: Array  # [W] int32, contacts that found no room in the engine (0 unless built too small)
    speed_limited: Array  # [W] int32, times that a speed limit of the physics acted
    missing_effects: Array  # [W] int32, what an engine made for fewer effects lacks, as bits: `Touching.missing`


class Environment:
    """Natively batched environment for the levels of one size. Stateless but for what it compiled."""

    def __init__(
        self,
        config: EnvConfig | None = None,
        *,
        engine: Engine | None = None,
        variants: Sequence[Effects] = (),
    ) -> None:
        """`engine` replaces the one that the config describes: one made for `effects_of(levels.scene)`, say.

        `variants`: effects of the engines that groups of worlds choose from, the last of them full
        (`effect_variants.choose_variants`); needed where `config.effect_groups` is not 0, and nowhere else.
        """
        self.config = config if config is not None else EnvConfig()
        capacity, groups = self.config.capacity, self.config.effect_groups
        if engine is not None and engine.capacity != capacity:
            raise ValueError(f"engine has {engine.capacity}, but size {self.config.size!r} is {capacity}")
        if bool(groups) != bool(variants):
            raise ValueError(
                f"EnvConfig.effect_groups is {groups} with {len(variants)} variants; give variants "
                "(effect_variants.choose_variants) for one group or more, and none for 0 groups"
            )
        self.variants = tuple(variants)
        settings = self.config.physics
        self.engine = engine if engine is not None else Engine(capacity, settings=settings)
        self._stepper: Stepper | GroupedStepper = Stepper(self.engine)
        if groups:
            if variants[-1] != Effects.full(capacity):
                raise ValueError("the last variant is not Effects.full(capacity); levels could be refused inside jit")
            engines = [Engine(capacity, settings=settings, effects=effects) for effects in variants]
            self._stepper = GroupedStepper(engines, groups)
        self._jit_prepare = jax.jit(self._prepare)
        self._jit_step = jax.jit(self._step)

    @property
    def capacity(self) -> Capacity:
        return self.config.capacity

    @property
    def action_space(self) -> ActionSpace:
        return ACTION_SPACES[self.config.action_space]

    @property
    def action_head_sizes(self) -> tuple[int, ...]:
        """Choices of each categorical head, (3, 3, 3, 3, 2, 2) for multi-discrete actions."""
        return self.action_space.head_sizes

    def prepare(self, levels: Level) -> PreparedLevels:
        """levels: a batch, [W, ...] on every field, of this environment's size.

        Raises ValueError for levels of another size and, where values are known (outside of jit), for levels that call
        for effects the engine was made without; inside jit `StepInfo.missing_effects` says so.
        """
        self._check_levels(levels)
        if self.engine.effects != Effects.full(self.capacity):
            self.engine.pack_scene(levels.scene)  # names what is missing, if anything is
        return self._jit_prepare(levels)

    def reset(self, prepared: PreparedLevels) -> tuple[EnvState, DynamicObs]:
        """The first state and observation of every world."""
        zeros = jnp.zeros_like(prepared.initial_distance)
        env_state = EnvState(
            packed_state=prepared.initial_packed_state,
            distance=prepared.initial_distance,
            num_steps=zeros.astype(jnp.int32),
            episode_return=zeros,
        )
        return env_state, prepared.initial_obs

    def step(
        self, prepared: PreparedLevels, env_state: EnvState, actions: Array
    ) -> tuple[EnvState, DynamicObs, Array, Array, StepInfo]:
        """One environment step of every world: (env_state, obs, reward [W] float32, done [W] bool, info).

        actions: see `spaces.py`; [W, 6] int32 for multi-discrete ones. Raises ValueError for a wrong shape or type
        and, where values are known (outside of jit), for numbers out of range; inside jit those act as "off" and
        are counted in `info.invalid_actions`.
        """
        self.action_space.check(actions, num_worlds=env_state.num_steps.shape[0])
        return self._jit_step(prepared, env_state, actions)

    def bodies_after(self, prepared: PreparedLevels, env_state: EnvState, controls: Controls) -> dict[str, Array]:
        """Position, angle, velocity and angular velocity, [W, n, ...], that one step leads to, before any reset."""
        packed_state, _ = self._physics(prepared, env_state, controls)
        bodies = self._stepper.bodies(prepared.packed_scene, packed_state)
        return dict(zip(("position", "angle", "velocity", "angular_velocity"), bodies, strict=True))

    def _physics(self, prepared: PreparedLevels, env_state: EnvState, controls: Controls) -> tuple[Any, Touching]:
        return self._stepper.step(prepared.packed_scene, env_state.packed_state, controls, self.config.frame_skip)

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
                    f"levels have room for {number} {name}, size {self.config.size!r} for {getattr(capacity, name)}; "
                    "fit the levels to the size or choose another size"
                )

    def _prepare(self, levels: Level) -> PreparedLevels:
        state = self.engine.initial_state(
            levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity
        )
        packed_scene, packed_state = self._stepper.pack(levels.scene, state)
        roles = role_masks(levels.shape_role, levels.scene.shapes.active)
        num_worlds, num_shapes = levels.shape_role.shape
        untouched = jnp.zeros((num_worlds, num_shapes, self.capacity.touch_words), jnp.uint32)
        position, angle, velocity, angular_velocity = self._stepper.bodies(packed_scene, packed_state)
        return PreparedLevels(
            packed_scene=packed_scene,
            initial_packed_state=packed_state,
            initial_obs=dynamic_obs(position, angle, velocity, angular_velocity, untouched),
            initial_distance=goal_distance(position, roles),
            static_obs=static_obs(levels),
            roles=roles,
            motor_colour=levels.motor_colour,
            motor_auto=levels.motor_auto,
            thruster_colour=levels.thruster_colour,
        )

    def _step(
        self, prepared: PreparedLevels, env_state: EnvState, actions: Array
    ) -> tuple[EnvState, DynamicObs, Array, Array, StepInfo]:
        # Actions drive motors and thrusters by colour.
        controls, num_invalid = controls_of(
            self.action_space, actions, prepared.motor_colour, prepared.motor_auto, prepared.thruster_colour
        )
        # Physics.
        packed_state, touching = self._physics(prepared, env_state, controls)
        position, angle, velocity, angular_velocity = self._stepper.bodies(prepared.packed_scene, packed_state)
        # Outcome and reward, from the state the step led to.
        obs = dynamic_obs(position, angle, velocity, angular_velocity, touching.at_end)
        num_steps = env_state.num_steps + 1
        outcome = judge(
            touching.during,
            prepared.roles,
            is_finite=jnp.isfinite(obs.bodies).all(axis=(1, 2)),
            is_last_step=num_steps >= self.config.max_steps,
        )
        distance = goal_distance(position, prepared.roles)
        reward = reward_of(outcome, env_state.distance, distance, dense_scale=self.config.dense_reward_scale)
        episode_return = env_state.episode_return + reward
        info = _step_info(outcome, episode_return, num_steps, num_invalid, touching)
        # A finished episode restarts on its level.
        next_state = EnvState(
            packed_state=packed_state, distance=distance, num_steps=num_steps, episode_return=episode_return
        )
        next_state, obs = self._auto_reset(prepared, outcome.done, next_state, obs)
        return next_state, obs, reward, outcome.done, info

    def _auto_reset(
        self, prepared: PreparedLevels, done: Array, env_state: EnvState, obs: DynamicObs
    ) -> tuple[EnvState, DynamicObs]:
        first_state, first_obs = self.reset(prepared)
        return EnvState(
            packed_state=self._stepper.select(
                prepared.packed_scene, done, first_state.packed_state, env_state.packed_state
            ),
            distance=select_worlds_first(done, first_state.distance, env_state.distance),
            num_steps=select_worlds_first(done, first_state.num_steps, env_state.num_steps),
            episode_return=select_worlds_first(done, first_state.episode_return, env_state.episode_return),
        ), select_worlds_first(done, first_obs, obs)


def _step_info(
    outcome: Outcome, episode_return: Array, num_steps: Array, num_invalid: Array, touching: Touching
) -> StepInfo:
    return StepInfo(
        solved=outcome.solved,
        failed=outcome.failed,
        timed_out=outcome.timed_out,
        unstable=outcome.unstable,
        episode_return=episode_return,
        episode_length=num_steps,
        invalid_actions=num_invalid,
        invalid_controls=touching.invalid_controls,
        invalid_scene=touching.invalid_scene,
        contact_overflow=touching.overflow,
        speed_limited=touching.limited,
        missing_effects=touching.missing,
    )


def world_partition_specs(tree: Any, axis: str = "data") -> Any:
    """A PartitionSpec for every leaf of `tree` that shards its worlds over the mesh axis `axis`.

    `tree` holds PreparedLevels, EnvState, observations or anything else whose leaves have the world axis first, in
    any nesting, as arrays or ShapeDtypeStructs. Packed engine arrays (`PACKED_FIELDS`) have it last. Raises ValueError
    for grouped worlds (`EnvConfig.effect_groups`): their order is that of one device, so prepare them inside shard_map.
    """
    _refuse_grouped(tree, "spread over devices; prepare the levels inside shard_map")

    def spec(path: tuple[Any, ...], leaf: Any) -> PartitionSpec:
        if any(getattr(entry, "name", None) in PACKED_FIELDS for entry in path):
            return PartitionSpec(*[None] * (leaf.ndim - 1), axis)
        return PartitionSpec(axis)

    return jax.tree_util.tree_map_with_path(spec, tree)


def select_worlds(tree: Any, index: Array) -> Any:
    """Picks worlds (a [K] index array) from PreparedLevels or EnvState, packed arrays included. Raises ValueError for
    grouped worlds, whose order inside is their own."""
    _refuse_grouped(tree, "picked from; pick levels and prepare those")

    def pick(path: tuple[Any, ...], leaf: Array) -> Array:
        is_packed = any(getattr(entry, "name", None) in PACKED_FIELDS for entry in path)
        return leaf[..., index] if is_packed else leaf[index]

    return jax.tree_util.tree_map_with_path(pick, tree)


def _refuse_grouped(tree: Any, what: str) -> None:
    nodes = jax.tree.leaves(tree, is_leaf=lambda x: isinstance(x, GroupedScene | GroupedState))
    if any(isinstance(x, GroupedScene | GroupedState) for x in nodes):
        raise ValueError(f"worlds grouped by effects (EnvConfig.effect_groups) cannot be {what}, or use 0 groups")
