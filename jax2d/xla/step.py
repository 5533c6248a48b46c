"""One world, any number of physics steps. Read this file first."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import BackendReport, Capacity, Controls, Scene, State, pack_bits
from jax2d.solver_numbers import SolverNumbers
from jax2d.xla import bodies as bodies_of
from jax2d.xla import (
    bounces,
    contact_solver,
    forces,
    geometry,
    impact_propagation,
    paper,
    reports,
)
from jax2d.xla import contacts as contacts_of
from jax2d.xla import islands as islands_of
from jax2d.xla import joints as joints_of
from jax2d.xla import springs as springs_of
from jax2d.xla.active_set import ActiveSet
from jax2d.xla.bodies import Bodies, Velocities
from jax2d.xla.branching import choose, in_any_world
from jax2d.xla.contacts import ContactCache, Contacts
from jax2d.xla.joints import Joints
from jax2d.xla.prediction import outruns_contacts
from jax2d.xla.rules import Rules


class Progress(NamedTuple):
    """A step under way."""

    bodies: Bodies
    joints: Joints
    contacts: Contacts
    cache: ContactCache  # of contacts solved before
    touch: jax.Array  # [n, n] bool, who touched whom in this step
    overflow: jax.Array  # [] int32
    v_at_detection: Velocities  # when contacts were found
    max_energy: jax.Array  # [] J, what bounces may leave the world with
    tally: reports.Tally | None  # of what contacts did, if that is reported


def run(
    scene: Scene,
    state: State,
    controls: Controls,
    params: SolverNumbers,
    *,
    rules: Rules,
    capacity: Capacity,
    num_steps: int,
) -> tuple[State, BackendReport]:
    """Steps one world. `scene.shapes.can_touch` holds each pair that may touch once, at [lower, higher]; shapes
    that are not active have no mass."""
    one_step = soft_step if rules.is_soft else paper_step

    def body(state: State, _: None) -> tuple[State, tuple]:
        end = one_step(scene, state, controls, params, rules, capacity)
        bodies = bodies_of.end_step(end.bodies)
        after = State(
            position=bodies.position,
            angle=bodies.angle,
            velocity=bodies.velocities.velocity,
            angular_velocity=bodies.velocities.omega,
            joint_impulse=joints_of.store(end.bodies, end.joints, state, rules),
            spring_impulse=springs_of.store(end.bodies, end.joints.springs, state),
            contact_key=end.cache.key,
            contact_impulse=end.cache.impulse,
            rolling_impulse=state.rolling_impulse if end.cache.rolling is None else end.cache.rolling,
        )
        return after, (end.touch, end.overflow, bodies.limited, end.tally)

    state, (touch, overflow, limited, tally) = jax.lax.scan(body, state, length=num_steps)
    return state, BackendReport(
        at_end=pack_bits(touch[-1]),
        during=pack_bits(jnp.any(touch, axis=0)),
        overflow=jnp.sum(overflow, dtype=jnp.int32),
        limited=jnp.sum(limited, dtype=jnp.int32),
        contacts=None if tally is None else reports.report_of(jax.tree.map(lambda x: x[-1], tally)),
    )


class StepState(NamedTuple):
    """A step of sub-steps under way."""

    progress: Progress
    substep: jax.Array  # [] int32, that is solved next
    interrupted: jax.Array  # [] bool, it was stopped before anything moved: forces have acted in it
    find: jax.Array  # [] bool, contacts are found before it is solved
    every_substep: (
        jax.Array
    )  # [] bool, contacts are found in each sub-step, where a body turns too far for those found once
    interruptions: jax.Array  # [] int32
    v_substep_start: Velocities  # of the sub-step, when forces had acted and nothing had been solved


def soft_step(
    scene: Scene, state: State, controls: Controls, params: SolverNumbers, rules: Rules, capacity: Capacity
) -> Progress:
    """Soft-step sub-stepping (Box2D v3): contacts found once, then solved in sub-steps of h."""
    h = params.h
    thrusters = forces.load(bodies_of.load(scene, state), scene, controls, params)
    context = contacts_of.Context(scene, params, rules, capacity)

    def find(bodies: Bodies, cache: ContactCache, dt: jax.Array, is_start: jax.Array) -> Contacts:
        return contacts_of.find(bodies, geometry.build(scene, bodies), cache, context, dt, is_start)

    def solve(now: StepState) -> StepState:
        bodies, joints, contacts, cache, touch, overflow, v_at_detection, max_energy, tally = now.progress
        _, substep, interrupted, is_found, every_substep, interruptions, v_substep_start = now
        left = h * jnp.where(every_substep, 1, rules.substeps - substep)
        found = bodies_of.end_step(bodies)
        found_contacts = find(found, cache, left, ~interrupted)
        found_joints = joints_of.prepare(found, scene, joints.warm_start_impulses(), controls, params)
        found_energy = bounces.energy(found, found.velocities, scene.gravity, h)
        # Of a sub-step that was stopped, bodies have had the impulses already.
        found_energy -= jnp.where(interrupted, bounces.carried_work(found, found_joints, found_contacts, h), 0)
        bodies, contacts, joints, v_at_detection, max_energy = choose(
            is_found,
            (found, found_contacts, found_joints, found.velocities, found_energy),
            (bodies, contacts, joints, v_at_detection, max_energy),
        )
        if tally is not None:
            tally = choose(is_found, reports.begin(tally, contacts), tally)
            tally = choose(interrupted, tally, reports.warm_start(tally))
        every_substep = jnp.where((substep == 0) & ~interrupted, contacts.each_substep, every_substep)

        driven = bodies_of.apply_gravity(bodies, scene.gravity, h)
        driven = forces.apply(driven, thrusters, h)
        driven = forces.apply_external(driven, controls, h)
        driven = bodies_of.apply_damping(driven, scene, h)
        v_substep_start = choose(interrupted, v_substep_start, driven.velocities)
        driven = joints_of.warm_start(driven, joints)
        driven, warm_contacts = contact_solver.warm_start(driven, contacts)
        bodies, contacts = choose(interrupted, (bodies, contacts), (driven, warm_contacts))
        bodies, joints, contacts = _solve_passes(bodies, joints, contacts, params, rules, use_bias=True)
        # Where a body would now go farther than was predicted, contacts are found again before anything moves.
        can_touch, reach = scene.shapes.can_touch, params.speculative_distance
        outruns = outruns_contacts(bodies, contacts.predicted, contacts.pair, can_touch, reach, left)
        interrupted = outruns & (interruptions < C.max_interruptions)
        moved = bodies_of.move(bodies, h, params.max_speed, params.max_angular_speed)
        bodies = choose(interrupted, bodies, moved)
        substep = jnp.where(interrupted, substep, substep + 1)
        interruptions = jnp.where(interrupted, interruptions + 1, interruptions)
        bodies, joints, contacts = _relax(bodies, joints, contacts, v_substep_start, params, rules)
        max_energy += jnp.sum(joints_of.motor_work(bodies, joints)) + forces.work(bodies, thrusters, h)
        max_energy += jnp.sum(springs_of.work(bodies, joints.springs))
        max_energy += forces.external_work(bodies, controls, h)
        carried = bounces.carried_work(bodies, joints, contacts, h)
        max_energy += carried

        is_end = interrupted | every_substep | (substep == rules.substeps)
        rebound_target = jnp.where(is_end, bounces.rebound_speed(bodies, contacts, scene.gravity, params), 0)
        rebound_target, contacts = impact_propagation.propagate(bodies, v_at_detection, contacts, rebound_target)
        energy_limit = bounces.EnergyLimit(max_energy, carried, scene.gravity)
        bounced, bounce_impulses = bounces.bounce(bodies, joints, contacts, rebound_target, energy_limit, params, rules)
        bounced = bodies_of.limit_speeds(bounced, params.max_speed, params.max_angular_speed)
        if tally is not None:
            tally = reports.add(tally, contacts)
            tally = reports.add_impulse(tally, contacts, jnp.where(is_end, bounce_impulses, 0))
        progress = Progress(bodies, joints, contacts, cache, touch, overflow, v_at_detection, max_energy, tally)
        ended = _finish_contacts(progress._replace(bodies=bounced), contacts.is_impact | (rebound_target > 0))
        progress = choose(is_end, ended, progress)
        return StepState(progress, substep, interrupted, is_end, every_substep, interruptions, v_substep_start)

    def solve_unless_done(now: StepState, _: None) -> tuple[StepState, None]:
        is_left = now.substep < rules.substeps
        return jax.lax.cond(in_any_world(is_left), lambda: choose(is_left, solve(now), now), lambda: now), None

    start = _begin(scene, state, controls, params)
    no_contacts = jax.eval_shape(find, start[0], start[2], jnp.zeros_like(scene.gravity[0]), jnp.array(True))
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), no_contacts)
    progress = Progress(start[0], start[1], empty, start[2], *_nothing_recorded(capacity, start[0], rules))
    none, no = jnp.zeros((), jnp.int32), jnp.array(False)
    step_state = StepState(progress, none, no, ~no, no, none, progress.v_at_detection)
    # One program for sub-steps, those that find contacts every_substep, and those that are stopped.
    step_state, _ = jax.lax.scan(solve_unless_done, step_state, length=rules.substeps + C.max_interruptions)
    return step_state.progress


class Pass(NamedTuple):
    """A pass over joints and contacts that others may follow."""

    bodies: Bodies
    joints: Joints
    contacts: Contacts
    active: ActiveSet
    follows: jax.Array  # [] bool, it is called for
    was_limited: jax.Array  # [] bool, a speed limit has acted


def _solve_passes(
    bodies: Bodies,
    joints: Joints,
    contacts: Contacts,
    params: SolverNumbers,
    rules: Rules,
    *,
    use_bias: bool,
    only: jax.Array | None = None,
) -> tuple[Bodies, Joints, Contacts]:
    """`only`: the bodies [n] that this is about; None: all.

    Joints first, so that contacts have the last word: a heavy body must not push through a jointed light one. With
    bias, where a speed limit takes back what stops a body, the rest of it is solved again. And where something hits,
    passes go on until all that it reaches has its share.
    """
    everything = ActiveSet.everything(bodies) if only is None else ActiveSet.of(only)

    def solve(now: Pass, index: jax.Array) -> Pass:
        def joint_pass(carry: tuple[Bodies, Joints], _: None) -> tuple[tuple[Bodies, Joints], jax.Array]:
            *carry, moved = joints_of.solve_soft(*carry, params, now.active, use_bias=use_bias)
            return tuple(carry), moved

        joint_passes = C.joint_passes if use_bias else 1
        (bodies, joints), moved = jax.lax.scan(joint_pass, (now.bodies, now.joints), length=joint_passes)
        moved = jnp.any(moved, axis=0)
        bodies, contacts, hit = contact_solver.solve_soft(bodies, now.contacts, params, now.active, use_bias=use_bias)
        next_active = ActiveSet(moved | hit, jnp.array(True), everything.only)
        follows = jnp.any(next_active.now) & (index < rules.impact_passes)
        if not use_bias:
            return Pass(bodies, joints, contacts, next_active, follows, now.was_limited)
        limited = bodies_of.limit_speeds(bodies, params.max_speed, params.max_angular_speed)
        is_limited = (limited.limited > bodies.limited) & jnp.any(contacts.key >= 0) & (index < C.limited_passes)
        limited = limited._replace(limited=jnp.where(now.was_limited, bodies.limited, limited.limited))  # counted once
        next_active = choose(is_limited, everything, next_active)
        return Pass(limited, joints, contacts, next_active, follows | is_limited, now.was_limited | is_limited)

    def one_pass(now: Pass, index: jax.Array) -> tuple[Pass, None]:
        def solved() -> Pass:
            return choose(now.follows, solve(now, index), now)

        return jax.lax.cond(in_any_world(now.follows), solved, lambda: now), None

    first = Pass(bodies, joints, contacts, everything, follows=jnp.array(True), was_limited=jnp.array(False))
    num_passes = 1 + max(rules.impact_passes, C.limited_passes if use_bias else 0)
    last, _ = jax.lax.scan(one_pass, first, jnp.arange(num_passes))
    return last.bodies, last.joints, last.contacts


class Relaxed(NamedTuple):
    """A world without bias, and what has gained energy by that."""

    bodies: Bodies
    joints: Joints
    contacts: Contacts
    gains: jax.Array  # [n] bool


def _relax(
    bodies: Bodies, joints: Joints, contacts: Contacts, v_substep_start: Velocities, params: SolverNumbers, rules: Rules
) -> tuple[Bodies, Joints, Contacts]:
    """Solves without bias, islands that gain energy by that again."""
    islands = islands_of.find(bodies, contacts, joints)
    allowed = islands_of.max_energy(bodies, v_substep_start, params.h)

    def solve(now: Relaxed, index: jax.Array) -> Relaxed:
        reset = islands_of.reset_impulses(islands, now.bodies, now.joints, now.contacts, v_substep_start, now.gains)
        is_reset = index == C.energy_passes_before_reset
        start = choose(is_reset, reset, (now.bodies, now.joints, now.contacts))
        end = _solve_passes(*start, params, rules, use_bias=False, only=now.gains)
        spare = jnp.where(index + 1 == C.energy_passes_before_reset, C.reset_gain, 0)
        gains = now.gains & islands_of.gains_energy(islands, *end, allowed, params.h, spare)
        return Relaxed(*end, gains)

    def one_pass(now: Relaxed, index: jax.Array) -> tuple[Relaxed, None]:
        gains = jnp.any(now.gains)

        def solved() -> Relaxed:
            return choose(gains, solve(now, index), now)

        return jax.lax.cond(in_any_world(gains), solved, lambda: now), None

    first = Relaxed(bodies, joints, contacts, gains=jnp.ones(bodies.inverse_mass.shape, bool))
    last, _ = jax.lax.scan(one_pass, first, jnp.arange(1 + C.energy_passes))
    return last.bodies, last.joints, last.contacts


def paper_step(
    scene: Scene, state: State, controls: Controls, params: SolverNumbers, rules: Rules, capacity: Capacity
) -> Progress:
    """The main loop of the paper's appendix (algorithm 1)."""
    bodies, joints, cache = _begin(scene, state, controls, params)
    # The appendix counts turns.
    joints = joints._replace(start_angle=joints_of.counted_angle(bodies, scene))
    bodies = bodies._replace(wraps=jnp.zeros_like(bodies.wraps))
    bodies = bodies_of.apply_gravity(bodies, scene.gravity, params.dt)
    context = contacts_of.Context(scene, params, rules, capacity)
    contacts = contacts_of.find(bodies, geometry.build(scene, bodies), cache, context, params.dt)
    bodies = paper.apply_motors(bodies, joints, params)
    bodies = forces.apply(bodies, forces.load(bodies, scene, controls, params), params.dt)
    bodies, contacts = contact_solver.warm_start(bodies, contacts)
    *recorded, tally = _nothing_recorded(capacity, bodies, rules)
    if tally is not None:
        tally = reports.warm_start(reports.begin(tally, contacts))
    bodies, joints = paper.warm_start(bodies, joints)

    def iteration(carry: tuple[Bodies, Joints, Contacts], _: None) -> tuple[tuple[Bodies, Joints, Contacts], None]:
        bodies, joints, contacts = carry
        bodies, joints = paper.solve(bodies, joints, params)
        bodies, contacts = paper.solve_hard(bodies, contacts, params, rules)
        return (bodies, joints, contacts), None

    (bodies, joints, contacts), _ = jax.lax.scan(iteration, (bodies, joints, contacts), length=rules.substeps)
    bodies = bodies_of.move(bodies, params.dt, params.max_speed, params.max_angular_speed)
    if tally is not None:
        tally = reports.add(tally, contacts)
    return _finish_contacts(Progress(bodies, joints, contacts, cache, *recorded, tally))


def _begin(
    scene: Scene, state: State, controls: Controls, params: SolverNumbers
) -> tuple[Bodies, Joints, ContactCache]:
    bodies = bodies_of.load(scene, state)
    joints = joints_of.prepare(bodies, scene, joints_of.load(state, params), controls, params)
    rolling = state.rolling_impulse if state.rolling_impulse.shape[0] else None
    return bodies, joints, ContactCache(state.contact_key, state.contact_impulse, rolling)


def _nothing_recorded(
    capacity: Capacity, bodies: Bodies, rules: Rules
) -> tuple[jax.Array, jax.Array, Velocities, jax.Array, reports.Tally | None]:
    """Touch matrix, overflow, velocities, energy and tally of a step that begins."""
    touch, overflow = jnp.zeros((capacity.shapes, capacity.shapes), bool), jnp.zeros((), jnp.int32)
    dtype = bodies.angle.dtype
    tally = reports.nothing(capacity, dtype) if rules.report_contacts else None
    return touch, overflow, bodies.velocities, jnp.zeros((), dtype), tally


def _finish_contacts(progress: Progress, transient: jax.Array | bool = False) -> Progress:
    """Records who touched, and caches the impulses for the contacts found next, none of impacts and bounces."""
    contacts, tally = progress.contacts, progress.tally
    return progress._replace(
        tally=None if tally is None else reports.locate(tally, progress.bodies, contacts),
        cache=contacts_of.cache_of(contacts, transient),
        touch=progress.touch | touching(contacts),
        overflow=progress.overflow + contacts.overflow,
    )


def touching(contacts: Contacts) -> jax.Array:
    """[n, n] bool: shapes touch when their contact carried an impulse in the step or they overlap."""
    touches = (contacts.max_impulse > 0) | (contacts.separation <= 0)
    pair = contacts.pair
    one_way = jnp.any(touches[:, None, None] & pair.is_a[:, :, None] & pair.is_b[:, None, :], axis=0)
    return one_way | one_way.T
