"""One world, any number of physics steps. Read this file first."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.measure import num_open
from jax2d.scene import BackendReport, Capacity, Controls, Scene, State, pack_bits
from jax2d.solver_numbers import SolverNumbers
from jax2d.xla import bodies as bodies_of
from jax2d.xla import (
    bounces,
    contact_solver,
    forces,
    geometry,
    impact_propagation,
    line_search,
    paper,
    reports,
)
from jax2d.xla import contacts as contacts_of
from jax2d.xla import islands as islands_of
from jax2d.xla import joints as joints_of
from jax2d.xla import springs as springs_of
from jax2d.xla.active_set import ActiveSet, has_one_of, marked
from jax2d.xla.bodies import Bodies, Velocities
from jax2d.xla.bounces import Solved
from jax2d.xla.branching import choose, in_any_world
from jax2d.xla.contacts import ContactCache, Contacts
from jax2d.xla.islands import Islands
from jax2d.xla.joints import Constraints, Joints, PlacedJoints
from jax2d.xla.prediction import Found, outruns_contacts
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
    max_energy: jax.Array  # [n] J, what bounces may leave, summed over an island
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
            joint_impulse=joints_of.store(end.joints, state),
            spring_impulse=joints_of.store_springs(end.bodies, end.joints, state),
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
        open_joints=num_open(scene, state.position, state.angle),
        contacts=None if tally is None else reports.report_of(jax.tree.map(lambda x: x[-1], tally)),
    )


class StepState(NamedTuple):
    """A step of sub-steps under way."""

    progress: Progress
    substep: jax.Array  # [] int32, that is solved next
    stopped: jax.Array  # [] bool, `found` were before they moved: forces have acted, and only they are solved
    stops: jax.Array  # [] int32, in this sub-step
    found: jax.Array  # [n] bool, their contacts are found before it is solved
    every: jax.Array  # [n] bool, their contacts are found in each sub-step, since those found once would not hold
    waiting: jax.Array  # [n] bool, they have not moved yet in this sub-step
    v_substep_start: Velocities  # of the sub-step, when forces had acted and nothing had been solved


def soft_step(
    scene: Scene, state: State, controls: Controls, params: SolverNumbers, rules: Rules, capacity: Capacity
) -> Progress:
    """Soft-step sub-stepping (Box2D v3): contacts found once, then solved in sub-steps of h."""
    h = params.h
    thrusters = forces.load(bodies_of.load(scene, state), scene, controls, params)
    context = contacts_of.Context(scene, params, rules, capacity)

    def find(bodies: Bodies, cache: ContactCache, dt: jax.Array, is_start: jax.Array, which: jax.Array) -> Contacts:
        return contacts_of.find(bodies, geometry.build(scene, bodies), cache, context, dt, is_start, which)

    def solve(now: StepState) -> StepState:
        bodies, joints, contacts, cache, touch, overflow, v_at_detection, max_energy, tally = now.progress
        _, substep, stopped, stops, found, every, waiting, v_substep_start = now
        is_all = (substep == 0) & ~stopped
        bodies = bodies_of.end_step(bodies, found)
        found_contacts = find(bodies, cache, h * jnp.where(is_all, rules.substeps, 1), ~stopped, found)
        is_found = jnp.any(found)
        contacts = contacts_of.replace_found(contacts, found_contacts, found)
        overflow += jnp.where(is_found, contacts.overflow, 0)
        found_joints = joints_of.prepare(bodies, scene, joints.warm_start_impulses(), controls, params)
        joints = joints_of.replace_found(joints, found_joints, found & bodies.is_dynamic)
        islands = islands_of.find(bodies, contacts, joints)
        every = jnp.where(is_all, islands.whole_groups(contacts.unsteady), every)
        v_at_detection = Velocities(
            jnp.where(found[:, None], bodies.velocities.velocity, v_at_detection.velocity),
            jnp.where(found, bodies.velocities.omega, v_at_detection.omega),
        )
        found_energy = bounces.energy(bodies, bodies.velocities, scene.gravity, h)
        # Of a sub-step that was stopped, bodies have had the impulses already.
        found_rows = joints_of.constraints(bodies, joints)
        found_energy -= jnp.where(stopped, bounces.carried_work(bodies, joints, found_rows, contacts, h), 0)
        max_energy = jnp.where(found, found_energy, max_energy)
        if tally is not None:
            tally = choose(is_found, reports.begin(tally, contacts), tally)
            tally = choose(stopped, tally, reports.warm_start(tally))

        driven = bodies_of.apply_gravity(bodies, scene.gravity, h)
        driven = forces.apply(driven, thrusters, h)
        driven = forces.apply_external(driven, controls, h)
        driven = bodies_of.apply_damping(driven, scene, h)
        v_substep_start = choose(stopped, v_substep_start, driven.velocities)
        driven = springs_of.warm_start(driven, joints.springs)
        driven, warm_contacts = contact_solver.warm_start(driven, contacts)
        turning = joints_of.stretched(driven, joints, h)
        joints = choose(stopped, joints, joints_of.without_impulses(joints))
        turning = jnp.where(stopped, driven.inverse_inertia, turning)
        bodies, contacts = choose(stopped, (bodies, contacts), (driven, warm_contacts))
        solved = found | ~stopped
        rows = joints_of.constraints(bodies, joints)
        bodies, joints, contacts = _solve_passes(
            Solved(bodies, joints, contacts), islands, params, rules, only=solved, turning=turning
        )
        # Islands of bodies that would now go farther than was predicted are stopped before they move: their contacts
        # are found again, from here on in each sub-step.
        outrunning = outruns_contacts(
            bodies,
            contacts.predicted,
            contacts.pair,
            scene.shapes.can_touch,
            params.speculative_distance,
            Found(found, every, waiting, left=h * (rules.substeps - substep), h=h),
        )
        outrunning = islands.whole_groups(outrunning) & (stops < C.max_stops)
        ends = every | (substep == rules.substeps - 1)
        moving = waiting & ~outrunning
        ending = (moving & ends) | (outrunning & (waiting | ~ends))
        bodies = bodies_of.move(bodies, h, params.max_speed, params.max_angular_speed, moving)
        bodies, joints, contacts = _relax(
            Solved(bodies, joints, contacts),
            rows,
            islands,
            (v_at_detection, v_substep_start),
            params,
            rules,
            only=solved,
        )
        work = bounces.driven_work(bodies, joints, rows) + forces.work(bodies, thrusters, h)
        work += forces.external_work(bodies, controls, h)
        carried = bounces.carried_work(bodies, joints, rows, contacts, h)
        max_energy += jnp.where(solved, work + carried, 0)

        is_ending = has_one_of(contacts.pair, ending & bodies.moves)
        rebound_target = jnp.where(is_ending, bounces.rebound_speed(bodies, contacts, scene.gravity, params), 0)
        rebound_target, contacts = impact_propagation.propagate(
            bodies, v_at_detection, contacts, islands, rebound_target
        )
        energy_limit = bounces.EnergyLimit(max_energy, carried, scene.gravity)
        bounced, bounce_impulses = bounces.bounce(
            Solved(bodies, joints, contacts),
            joints_of.place(bodies, joints),
            islands,
            rebound_target,
            energy_limit,
            params,
            rules,
        )
        bounced, _ = bodies_of.limit_speeds(bounced, params.max_speed, params.max_angular_speed, ending)
        if tally is not None and bounce_impulses is not None:  # both where contacts are reported, else neither
            tally = reports.add(tally, contacts)
            tally = reports.add_impulse(tally, contacts, bounce_impulses)
        # The impulse of a bounce does not last.
        contacts = contacts._replace(is_impact=contacts.is_impact | (rebound_target > 0))
        progress = Progress(bodies, joints, contacts, cache, touch, overflow, v_at_detection, max_energy, tally)
        ended = _finish_contacts(progress._replace(bodies=bounced), contacts.is_impact)
        progress = choose(jnp.any(ending), ended, progress)

        stopped = jnp.any(outrunning)
        every |= outrunning
        return StepState(
            progress,
            substep=jnp.where(stopped, substep, substep + 1),
            stopped=stopped,
            stops=jnp.where(stopped, stops + 1, 0),
            found=jnp.where(stopped, outrunning, every),
            every=every,
            waiting=(waiting & outrunning) | ~stopped,
            v_substep_start=v_substep_start,
        )

    def solve_unless_done(now: StepState, _: None) -> tuple[StepState, None]:
        is_left = now.substep < rules.substeps
        return jax.lax.cond(in_any_world(is_left), lambda: choose(is_left, solve(now), now), lambda: now), None

    start = _begin(scene, state, controls, params)
    everything = jnp.ones(start[0].angle.shape, bool)
    no_contacts = jax.eval_shape(
        find, start[0], start[2], jnp.zeros_like(scene.gravity[0]), jnp.array(True), everything
    )
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), no_contacts)
    progress = Progress(start[0], start[1], empty, start[2], *_nothing_recorded(capacity, start[0], rules))
    none, no = jnp.zeros((), jnp.int32), jnp.array(False)
    step_state = StepState(progress, none, no, none, everything, ~everything, everything, progress.v_at_detection)
    # One program for sub-steps, those that find contacts, and those that are stopped.
    step_state, _ = jax.lax.scan(solve_unless_done, step_state, length=rules.substeps * (1 + C.max_stops))
    return step_state.progress


class Pass(NamedTuple):
    """A pass over joints and contacts that others may follow."""

    bodies: Bodies
    joints: Joints
    contacts: Contacts
    active: ActiveSet
    held: jax.Array  # [n] bool, their spins stay at the limit


def _solve_passes(
    start: Solved,
    islands: Islands,
    params: SolverNumbers,
    rules: Rules,
    *,
    only: jax.Array,
    turning: jax.Array | None = None,
    sharing: tuple[PlacedJoints, jax.Array] | None = None,
) -> Solved:
    """Passes with bias, or without: joints are not relaxed, since with bias they have the velocities that keep anchors
    together. `only`: the bodies [n] that this is about. `turning`: their inverse inertias [n] with bias, by default
    the bodies' own. sharing: without bias, joints as the bodies stand, and [] bool whether they are solved all the
    same, since an island has gained energy.

    Joints, contacts, and joints again: so each has what the other answers. With bias, where a speed limit takes back
    what stops a body, the rest of it is solved again with all of its island: what is jointed keeps its spin at the
    limit then, and what is heavier and turns it faster gives way, or joints would come apart. And where something
    hits, passes go on until all that it reaches has its share.
    """
    bodies, joints, contacts = start
    use_bias = sharing is None
    inverse_inertia = start.bodies.inverse_inertia if turning is None else turning
    jointed = marked(bodies, joints.pair, jnp.any(joints.pair.is_a, axis=-1))
    touching = islands.whole(jointed | marked(bodies, contacts.pair, contacts.key >= 0))

    def solve(now: Pass, index: jax.Array) -> Pass:
        if sharing is not None:
            standing, has_gained = sharing
            bodies, springs, moved = springs_of.solve(
                now.bodies, now.joints.springs, params, now.active, use_bias=False
            )
            joints = now.joints._replace(springs=springs)
            shared = joints_of.solve_soft(now.bodies, now.joints, standing, params, now.active, use_bias=False)
            bodies, joints, moved = choose(has_gained, shared, (bodies, joints, moved))
        else:
            now = _with_inertia(now, jnp.where(now.held, 0, inverse_inertia))
            standing = joints_of.place(now.bodies, now.joints)
            bodies, joints, moved = joints_of.solve_soft(
                now.bodies, now.joints, standing, params, now.active, use_bias=True
            )
        bodies, contacts, joints, hit, given = contact_solver.solve_soft(
            bodies, now.contacts, (joints, standing), params, now.active, use_bias=use_bias
        )
        if use_bias:
            contacted = Solved(bodies, joints, contacts)
            if rules.line_search:
                bodies, contacts = line_search.apply(contacted, given, standing, islands, params, now.active)
            bodies, joints, moved_again = joints_of.solve_soft(
                bodies, joints, standing, params, now.active, use_bias=True, after=contacted.bodies.velocities
            )
            moved |= moved_again
        shared = (hit | (moved & islands.whole(now.active.moved))) & (index < rules.impact_passes)
        if not use_bias:
            return Pass(bodies, joints, contacts, ActiveSet(shared, shared), now.held)
        solved = islands.whole(now.active.now)
        bodies, slowed = bodies_of.limit_speeds(bodies, params.max_speed, params.max_angular_speed, solved)
        is_solved_again = index < C.limited_passes
        again = islands.whole(slowed) & touching & is_solved_again
        spins = jnp.abs(bodies.velocities.omega) >= params.max_angular_speed
        held = now.held | (slowed & jointed & spins & is_solved_again)
        shared &= ~again
        return Pass(bodies, joints, contacts, ActiveSet(shared | again, shared), held)

    def one_pass(now: Pass, index: jax.Array) -> tuple[Pass, None]:
        follows = jnp.any(now.active.now)

        def solved() -> Pass:
            return choose(follows, solve(now, index), now)

        return jax.lax.cond(in_any_world(follows), solved, lambda: now), None

    first = Pass(bodies, joints, contacts, ActiveSet.of(only), jnp.zeros_like(only))
    num_passes = 1 + max(rules.impact_passes, C.limited_passes if use_bias else 0)
    last, _ = jax.lax.scan(one_pass, first, jnp.arange(num_passes))
    last = _with_inertia(last, start.bodies.inverse_inertia)
    return Solved(last.bodies, last.joints, last.contacts)


def _with_inertia(now: Pass, inverse_inertia: jax.Array) -> Pass:
    """Bodies with these inverse inertias [n], and the same seen from all pairs."""

    def seen(part: Any) -> Any:
        if not isinstance(part, bodies_of.Pair):
            return part
        inertia_a, inertia_b = (bodies_of.pick(is_it, inverse_inertia) for is_it in (part.is_a, part.is_b))
        return part._replace(inertia_a=inertia_a, inertia_b=inertia_b)

    bodies = now.bodies._replace(inverse_inertia=inverse_inertia)
    joints, contacts = jax.tree.map(
        seen, (now.joints, now.contacts), is_leaf=lambda part: isinstance(part, bodies_of.Pair)
    )
    return now._replace(bodies=bodies, joints=joints, contacts=contacts)


class Relaxed(NamedTuple):
    """A world without bias, and what the island of each body has gained by that."""

    solved: Solved
    gains: jax.Array  # [n] J
    work: jax.Array  # [n] J, of motors, springs and what carries


def _relax(
    start: Solved,
    rows: Constraints,
    islands: Islands,
    before: tuple[Velocities, Velocities],
    params: SolverNumbers,
    rules: Rules,
    only: jax.Array,
) -> Solved:
    """Solves the bodies of `only` [n] bool, whole islands, without bias, islands that gain energy by that again.

    rows: of the joints before bodies moved. before: velocities when contacts were found, and those of the sub-step when
    forces had acted and nothing had been solved."""
    v_at_detection, v_substep_start = before
    drift = islands_of.drift(islands, start.bodies, v_at_detection)
    bound = islands_of.energy_bound(start.bodies, v_substep_start, drift, params.h)
    standing = joints_of.place(start.bodies, start.joints)

    def solve(now: Relaxed, index: jax.Array) -> Relaxed:
        gaining = now.gains > 0
        end = _solve_passes(now.solved, islands, params, rules, only=gaining, sharing=(standing, index > 0))
        gained, work = islands_of.energy_gained(islands, end.bodies, end.joints, rows, end.contacts, bound)
        return Relaxed(end, jnp.where(gaining, gained, 0), work)

    def one_pass(now: Relaxed, index: jax.Array) -> tuple[Relaxed, None]:
        gains = jnp.any(now.gains > 0)

        def solved() -> Relaxed:
            return choose(gains, solve(now, index), now)

        return jax.lax.cond(in_any_world(gains), solved, lambda: now), None

    none = jnp.zeros_like(bound.energy)
    first = Relaxed(start, gains=jnp.where(only, none + 1, none), work=none)
    last, _ = jax.lax.scan(one_pass, first, jnp.arange(1 + C.energy_passes))
    return Solved(*islands_of.limit_gains(islands, last.solved, v_substep_start, bound, (last.gains, last.work)))


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
    touch, overflow, velocities, max_energy, tally = _nothing_recorded(capacity, bodies, rules)
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
    progress = _finish_contacts(
        Progress(bodies, joints, contacts, cache, touch, overflow, velocities, max_energy, tally)
    )
    return progress._replace(overflow=contacts.overflow)


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
    return touch, overflow, bodies.velocities, jnp.zeros_like(bodies.angle), tally


def _finish_contacts(progress: Progress, transient: jax.Array | bool = False) -> Progress:
    """Records who touched, and caches the impulses for the contacts found next, none of impacts and bounces."""
    contacts, tally = progress.contacts, progress.tally
    return progress._replace(
        tally=None if tally is None else reports.locate(tally, progress.bodies, contacts),
        cache=contacts_of.cache_of(contacts, transient),
        touch=progress.touch | touching(contacts),
    )


def touching(contacts: Contacts) -> jax.Array:
    """[n, n] bool: shapes touch when their contact carried an impulse in the step or they overlap."""
    touches = (contacts.max_impulse > 0) | (contacts.separation <= 0)
    pair = contacts.pair
    one_way = jnp.any(touches[:, None, None] & pair.is_a[:, :, None] & pair.is_b[:, None, :], axis=0)
    return one_way | one_way.T
