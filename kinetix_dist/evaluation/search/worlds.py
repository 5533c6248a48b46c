"""Many copies of one level, played from its start or from any stored states. What every search is made of.

Steps as `Environment.step` does, without observations and without the restart of finished episodes: a world that is
over is stepped on, and what it does then does not count. A solution is replayed by the environment itself afterwards.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, stack_worlds
from kinetix_dist.env.action_spaces.space import controls_of
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.outcome import goal_distance, judge
from kinetix_dist.env.records import PreparedLevels
from kinetix_dist.level.level import (
    NUM_MOTOR_COLOURS,
    NUM_THRUSTER_COLOURS,
    Level,
    Role,
    driving_motors,
    motors_with_effect,
    pushing_thrusters,
)
from kinetix_dist.level.overlap import surface_distance, world_corners

START_NOISE_M_S = 1e-4  # on velocities of slightly different starts; a hundred times what float32 rounds off


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Played:
    """Outcome of some steps. [W] on every field; of the steps before a world was over, but for what is "at the end"."""

    solved_after: Array  # int32, steps until it was solved, 0 where it was not
    is_over: Array  # bool, solved, touched red or not finite
    min_distance: Array  # m, of the centres of green and blue, the least on the way
    min_gap: Array  # m, of the surfaces of green and blue, the least on the way
    distance: Array  # m, of the centres, at the end
    position: Array  # [W, n, 2] m, at the end
    angle: Array  # [W, n] rad, at the end
    velocity: Array  # [W, n, 2] m/s, at the end
    packed_state: Any  # at the end


class Budget:
    """Seconds that a search may take, and the steps it took."""

    def __init__(self, seconds: float) -> None:
        self._deadline = time.monotonic() + seconds
        self.num_steps = 0  # environment steps, all worlds together
        self.min_gap = float("inf")  # m, of the surfaces of green and blue, the least of all

    @property
    def is_spent(self) -> bool:
        return time.monotonic() >= self._deadline

    @property
    def seconds_left(self) -> float:
        return max(0.0, self._deadline - time.monotonic())

    def count(self, played: Played, num_steps: int) -> None:
        self.num_steps += num_steps * len(played.is_over)
        self.min_gap = min(self.min_gap, max(0.0, float(played.min_gap.min())))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class GoalPair:
    """Green and blue of a level, as `surface_distance` takes them."""

    slots: Array  # [2] int32, green and blue
    vertices: Array  # [2, V, 2] m, in their own frames
    radius: Array  # [2] m, 0 of a polygon

    @classmethod
    def of(cls, level: Level) -> GoalPair:
        shapes = level.scene.shapes
        num_polygons, num_corners = np.shape(shapes.vertices)[:2]
        roles = np.where(np.asarray(shapes.active), np.asarray(level.shape_role), Role.NONE)
        slots = np.array([int(np.flatnonzero(roles == role)[0]) for role in (Role.GREEN, Role.BLUE)], np.int32)
        vertices, radius = np.zeros((2, num_corners, 2), np.float32), np.zeros(2, np.float32)
        for i, slot in enumerate(slots.tolist()):
            if slot < num_polygons:
                vertices[i] = shapes.vertices[slot]
            else:
                radius[i] = shapes.radius[slot - num_polygons]
        return cls(slots=slots, vertices=vertices, radius=radius)

    def gap(self, position: Array, angle: Array) -> Array:
        """[W] m between their surfaces, of positions [W, n, 2] and angles [W, n]."""
        corners = world_corners(position[:, self.slots], angle[:, self.slots], self.vertices)
        between = jax.vmap(surface_distance, in_axes=(0, None, 0, None))
        return between(corners[:, 0], self.radius[0], corners[:, 1], self.radius[1])


class Worlds:
    """`num_worlds` copies of one level (numpy, without a leading axis) of the environment's size."""

    def __init__(self, env: Environment, level: Level, num_worlds: int) -> None:
        self.env, self.level, self.num_worlds = env, level, num_worlds
        self.prepared = env.prepare(stack_worlds([level] * num_worlds))
        self.movable = np.flatnonzero(level.scene.shapes.active & (level.scene.shapes.inverse_mass > 0))
        self.goal = GoalPair.of(level)
        self.green = int(self.goal.slots[0])

    @functools.cached_property
    def actions(self) -> np.ndarray:
        """Actions of `useful_actions`, which may raise."""
        return useful_actions(self.level)

    @property
    def max_steps(self) -> int:
        return self.env.config.max_steps

    @property
    def start(self) -> Any:
        """The packed state of all worlds at the start of the level."""
        return self.prepared.initial_packed_state

    def different_starts(self, rng: np.random.Generator) -> Any:
        """Packed states of starts whose velocities are off by START_NOISE_M_S, each world by something else."""
        noise = np.zeros((self.num_worlds, *self.level.velocity.shape), np.float32)
        noise[:, self.movable] = rng.normal(0.0, START_NOISE_M_S, (self.num_worlds, len(self.movable), 2))
        levels = stack_worlds([self.level] * self.num_worlds)
        return self.env.pack(dataclasses.replace(levels, velocity=levels.velocity + noise))[1]

    def play(self, packed_state: Any, actions: np.ndarray, budget: Budget | None = None) -> Played:
        """Plays actions [T, W, A] int32 from the given states. Compiles once for each (environment, T, W)."""
        played = jax.device_get(
            _play(self.env, self.prepared, self.goal, packed_state, jnp.asarray(actions, jnp.int32))
        )
        if budget is not None:
            budget.count(played, len(actions))
        return played

    def episodes(self, actions: np.ndarray, budget: Budget | None = None) -> Played:
        """Whole episodes from the start, actions [max_steps, W, A]."""
        return self.play(self.start, actions, budget)


def useful_actions(level: Level) -> np.ndarray:
    """[K, 6] int32: the multi-discrete actions that differ in what they do to this level, doing nothing first.

    Raises ValueError for a level in which no action moves anything.
    """
    driving, obeying = driving_motors(level), motors_with_effect(level)
    flames = set(level.thruster_colour[pushing_thrusters(level)].tolist())
    if not driving.any() and not flames:
        brakes = ", and a motor of speed 0 can only brake" if obeying.any() else ""
        raise ValueError(
            "no action moves anything in it: it has no motor with a speed (but automatic ones) and no thruster that "
            f"moves a shape{brakes}"
        )
    motors, brakes_of = set(level.motor_colour[driving].tolist()), set(level.motor_colour[obeying].tolist())
    # Of a motor without a speed both directions are the same: it brakes.
    choices = [range(3 if colour in motors else 2 if colour in brakes_of else 1) for colour in range(NUM_MOTOR_COLOURS)]
    choices += [range(2) if colour in flames else range(1) for colour in range(NUM_THRUSTER_COLOURS)]
    return np.array(list(itertools.product(*choices)), np.int32)


def solutions(played: Played, actions: np.ndarray) -> list[np.ndarray]:
    """The actions [t, A] of each world that was solved, up to the step that solved it, the shortest first."""
    solved = np.flatnonzero(played.solved_after)
    order = solved[np.argsort(played.solved_after[solved], kind="stable")]
    return [actions[: played.solved_after[world], world] for world in order]


@functools.partial(jax.jit, static_argnums=0)
def _play(env: Environment, prepared: PreparedLevels, goal: GoalPair, packed_state: Any, actions: Array) -> Played:
    scene = prepared.packed_scene

    def step(carry: tuple, step_actions: Array) -> tuple[tuple, None]:
        state, solved_after, is_over, min_distance, min_gap, number = carry
        controls, _ = controls_of(
            env.action_space, step_actions, prepared.motor_colour, prepared.motor_auto, prepared.thruster_colour
        )
        state, touching = env.engine.step_packed(scene, state, controls, env.config.frame_skip)
        position, angle, velocity, spin = env.engine.bodies(state)
        numbers = jnp.concatenate([position, velocity, angle[..., None], spin[..., None]], axis=-1)
        outcome = judge(
            touching.during,
            prepared.roles,
            is_finite=jnp.isfinite(numbers).all(axis=(1, 2)),
            is_last_step=jnp.zeros_like(is_over),
        )
        solved_after = jnp.where(outcome.solved & ~is_over, number, solved_after)
        distance = goal_distance(position, prepared.roles)
        min_distance = jnp.where(is_over, min_distance, jnp.fmin(min_distance, distance))  # NaN is not near
        min_gap = jnp.where(is_over, min_gap, jnp.fmin(min_gap, goal.gap(position, angle)))
        return (state, solved_after, is_over | outcome.done, min_distance, min_gap, number + 1), None

    nothing = jnp.zeros_like(prepared.initial_distance)
    first = (
        packed_state,
        nothing.astype(jnp.int32),
        nothing.astype(bool),
        nothing + jnp.inf,
        nothing + jnp.inf,
        jnp.int32(1),
    )
    state, solved_after, is_over, min_distance, min_gap, _ = jax.lax.scan(step, first, actions)[0]
    position, angle, velocity, _ = env.engine.bodies(state)
    return Played(
        solved_after=solved_after,
        is_over=is_over,
        min_distance=min_distance,
        min_gap=min_gap,
        distance=goal_distance(position, prepared.roles),
        position=position,
        angle=angle,
        velocity=velocity,
        packed_state=state,
    )
