"""Plans in the environment, closed loop: compared with what was planned, replanned where it deviates.

Before every CHECK_STEPS steps the state is compared with the planned one. Where it deviates, and the rest of the plan
no longer solves the level from the state that there is, the planner goes on from that state with the time that is left.
Where there is no plan the policy acts. Outcomes are those of the environment, which replays the executed actions from
the start of the level; nothing that the planner says counts.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.evaluation.evaluate import Episodes, attempt_keys, no_episodes, record_first
from kinetix_dist.evaluation.planning.planner import Budget, Plan, Planner
from kinetix_dist.evaluation.planning.problems import Problems, over_actions, problems_at, state_of
from kinetix_dist.evaluation.policies import Player, Policy
from kinetix_dist.level.level import Level

CHECK_STEPS = 8
TOLERANCE_M, TOLERANCE_RAD = 1e-4, 1e-4  # what the same steps give on a device in another batch is less


@dataclasses.dataclass(frozen=True, kw_only=True)
class Executed:
    """Result of an execution, [N] on every field."""

    episodes: Episodes  # numpy, of the environment
    num_replans: np.ndarray  # int
    used: np.ndarray  # of the budget, for replans
    was_confirmed: np.ndarray  # bool: the environment ends as the execution did


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Real:
    """Worlds that are played once, [N, ...]."""

    number: Array  # [] int32, steps played
    env_state: EnvState
    obs: Any
    is_over: Array  # bool
    is_solved: Array  # bool
    keys: Array  # of the policy's actions


@dataclasses.dataclass(kw_only=True)
class Course:
    """Plans of N worlds in the steps of their episodes, and the states that they lead to."""

    actions: np.ndarray  # [T, N, ...]
    length: np.ndarray  # [N] int, steps that have a plan
    moments: np.ndarray  # [checks, N, n, 3] x, y (m), angle (rad) before every CHECK_STEPS steps

    def deviates(self, check: int, moment: np.ndarray) -> np.ndarray:
        """[N] bool, of the worlds that still follow a plan."""
        difference = np.abs(moment - self.moments[check])
        is_off = (difference > (TOLERANCE_M, TOLERANCE_M, TOLERANCE_RAD)).any(axis=(1, 2))
        return is_off & (self.length > check * CHECK_STEPS)

    def rest(self, check: int) -> tuple[np.ndarray, np.ndarray]:
        """(actions [T, N, ...] from a check on, and how many of them are planned [N])."""
        begin = check * CHECK_STEPS
        rest = np.zeros_like(self.actions)
        rest[: len(rest) - begin] = self.actions[begin:]
        return rest, np.maximum(0, self.length - begin)

    def replace(self, check: int, world: int, actions: np.ndarray | None) -> None:
        """Another plan from a check on; None: no plan."""
        begin = check * CHECK_STEPS
        self.length[world] = begin
        if actions is not None:
            self.length[world] = min(len(self.actions), begin + len(actions))
            self.actions[begin : self.length[world], world] = actions[: self.length[world] - begin]

    def follow(self, check: int, moments: np.ndarray, worlds: np.ndarray) -> None:
        """States that the plans of some worlds lead to from a check on."""
        self.moments[check:, worlds] = moments[: len(self.moments) - check, worlds]


def execute(
    planner: Planner, fallback: Player, levels: tuple[Level, Level], plans: Sequence[Plan], budget: Budget, key: Array
) -> Executed:
    """Executes a plan for each of N levels.

    levels: as the plans were made for them, and as they are, [N, ...] each; budget: what replans may take of each;
    key: of the actions of the fallback, which plays where there is no plan. It is consumed.
    """
    env, (planned_levels, true_levels) = planner.env, levels
    prepared = env.prepare(true_levels)
    env_state, obs = env.reset(prepared)
    number = len(plans)
    course = _course(env, plans)
    _, moments = _predict(env, prepared, env.pack(planned_levels)[1], env_state.num_steps, course.actions)
    course.moments = np.array(moments)
    no = env_state.num_steps < 0
    keys = attempt_keys(key, jnp.arange(number))
    real = Real(number=jnp.int32(0), env_state=env_state, obs=obs, is_over=no, is_solved=no, keys=keys)
    used, num_replans = np.zeros(number), np.zeros(number, int)
    executed = []
    for check in range(len(course.moments)):
        deviates = course.deviates(check, np.asarray(_moment(env, real.env_state.packed_state)))
        deviates &= ~np.asarray(real.is_over)
        if deviates.any():
            failing = _failing(env, prepared, real, course, check) & deviates
            if failing.any():
                index = np.flatnonzero(failing)
                used[index] += _replan(planner, true_levels, real, course, (check, index), budget.after(used))
                num_replans[index] += 1
            _, moments = _predict(env, prepared, *_now(real), course.rest(check)[0])
            course.follow(check, np.asarray(moments), deviates)
        steps = np.arange(check * CHECK_STEPS, min((check + 1) * CHECK_STEPS, env.config.max_steps))
        follows = steps[:, None] < course.length
        real, actions = _play(env, *fallback, prepared, real, (course.actions[steps], follows))
        executed.append(np.asarray(actions))
    episodes = jax.device_get(judged(env, true_levels, np.concatenate(executed)))
    return Executed(
        episodes=episodes,
        num_replans=num_replans,
        used=used,
        was_confirmed=episodes.solved == np.asarray(real.is_solved),
    )


def _course(env: Environment, plans: Sequence[Plan]) -> Course:
    noop = np.asarray(env.action_space.noop_actions(len(plans)))
    course = Course(
        actions=np.tile(noop, (env.config.max_steps, *[1] * noop.ndim)),
        length=np.zeros(len(plans), int),
        moments=np.zeros(0),
    )
    for world, plan in enumerate(plans):
        course.replace(0, world, plan.actions)
    return course


def _failing(env: Environment, prepared: PreparedLevels, real: Real, course: Course, check: int) -> np.ndarray:
    """[N] bool: the rest of the plan does not solve the level from the state that there is."""
    actions, length = course.rest(check)
    solved_after = np.asarray(_predict(env, prepared, *_now(real), actions)[0])
    return (solved_after == 0) | (solved_after > length)


def _replan(
    planner: Planner, levels: Level, real: Real, course: Course, at: tuple[int, np.ndarray], budget: Budget
) -> np.ndarray:
    """Searches from the states of some worlds, with their old plans as bases; returns what it used of the budget."""
    check, index = at
    actions, length = course.rest(check)
    problems = dataclasses.replace(
        problems_at(planner.env, levels, *_now(real)),
        base=jnp.asarray(actions),
        base_length=jnp.asarray(length, jnp.int32),
    )
    plans = planner.replan(problems, budget, index)
    for world, plan in zip(index, plans, strict=True):
        course.replace(check, int(world), plan.actions)
    return np.array([plan.used for plan in plans])


def _now(real: Real) -> tuple[Any, Array]:
    return real.env_state.packed_state, real.env_state.num_steps


@functools.partial(jax.jit, static_argnums=0)
def _moment(env: Environment, packed_state: Any) -> Array:
    """[N, n, 3]"""
    position, angle, _, _ = env.engine.bodies(packed_state)
    return jnp.concatenate([position, angle[..., None]], axis=-1)


@functools.partial(jax.jit, static_argnums=0)
def _predict(
    env: Environment, prepared: PreparedLevels, packed_state: Any, num_steps: Array, actions: Array
) -> tuple[Array, Array]:
    """(solved_after [N] steps, 0 where not, and moments [checks, N, n, 3]) of actions [T, N, ...]."""
    actions = jnp.asarray(actions)
    first = state_of(env, prepared, packed_state, num_steps)
    zeros = jnp.zeros_like(num_steps)

    def step(carry: tuple, step_actions: Array) -> tuple[tuple, Array]:
        env_state, is_over, solved_after, number = carry
        moment = _moment(env, env_state.packed_state)
        env_state, _, _, done, info = env.transition(prepared, env_state, step_actions)
        solved_after = jnp.where(info.solved & ~is_over, number, solved_after)
        return (env_state, is_over | done, solved_after, number + 1), moment

    (_, _, solved_after, _), moments = jax.lax.scan(step, (first, num_steps < 0, zeros, jnp.int32(1)), actions)
    return solved_after, moments[::CHECK_STEPS]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play(
    env: Environment, policy: Policy, params: Any, prepared: PreparedLevels, real: Real, planned: tuple[Array, Array]
) -> tuple[Real, Array]:
    """Some steps, by planned (actions [S, N, ...], where they are followed [S, N]), else by the policy."""

    def step(now: Real, at: tuple[Array, Array]) -> tuple[Real, Array]:
        planned, follows = at
        step_keys = jax.vmap(prng.fold_in, in_axes=(0, None))(now.keys, now.number)
        actions = policy(params, env.observe(prepared, now.obs), step_keys)
        actions = jnp.where(over_actions(follows, actions), planned, actions)
        env_state, obs, _, done, info = env.transition(prepared, now.env_state, actions)
        return dataclasses.replace(
            now,
            number=now.number + 1,
            env_state=env_state,
            obs=obs,
            is_over=now.is_over | done,
            is_solved=now.is_solved | (info.solved & ~now.is_over),
        ), actions

    return jax.lax.scan(step, real, planned)


@functools.partial(jax.jit, static_argnums=0)
def judged(env: Environment, levels: Level, actions: Array) -> Episodes:
    """First episodes of levels [N, ...] under actions [T, N, ...], by `Environment.step` from the start of each."""
    prepared = env.prepare(levels)
    env_state, _ = env.reset(prepared)

    def step(carry: tuple[EnvState, Episodes], step_actions: Array) -> tuple[tuple[EnvState, Episodes], None]:
        env_state, episodes = carry
        env_state, _, _, done, info = env.step(prepared, env_state, step_actions)
        return (env_state, record_first(episodes, done, info)), None

    return jax.lax.scan(step, (env_state, no_episodes(env_state.distance)), jnp.asarray(actions))[0][1]


def problems_of(env: Environment, levels: Level) -> Problems:
    """Problems at the starts of levels [N, ...]."""
    number = np.shape(levels.angle)[0]
    levels = jax.tree.map(jnp.asarray, levels)
    return problems_at(env, levels, env.pack(levels)[1], jnp.zeros(number, jnp.int32))
