"""Soft contacts in one pass of the soft-step solver of Box2D v3 (Solver2D study), solved one after another."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import Scalar, SolverNumbers
from jax2d.xla import joint_system, vec2
from jax2d.xla import joints as joints_of
from jax2d.xla.active_set import ActiveSet, marked
from jax2d.xla.bodies import (
    Bodies,
    Pair,
    PairVelocities,
    Velocities,
    apply_angular_impulse,
    apply_impulse,
    pair_mass,
    pair_velocities,
    pick,
    relative_velocity,
    scatter_velocities,
)
from jax2d.xla.branching import choose, in_any_world
from jax2d.xla.contacts import Contacts, reset_impulses
from jax2d.xla.joints import Joints, PlacedJoints


def warm_start(bodies: Bodies, contacts: Contacts) -> tuple[Bodies, Contacts]:
    """Applies the impulses of the step before. That of an impact is reset: it does not last."""
    contacts = reset_impulses(contacts, contacts.is_impact)
    return apply_impulses(bodies, contacts), contacts


def apply_impulses(bodies: Bodies, contacts: Contacts) -> Bodies:
    """Applies all impulses of contacts at once, where the bodies are now: they do not depend on one another."""
    impulse = (
        contacts.normal * contacts.impulse_normal[:, None]
        + vec2.right(contacts.normal) * contacts.impulse_tangent[:, None]
    )
    before = pair_velocities(contacts.pair, bodies.velocities)
    after = apply_impulse(before, contacts.pair, *arms_now(bodies, contacts), impulse)
    if contacts.rolling_impulse is not None:
        after = apply_angular_impulse(after, contacts.pair, contacts.rolling_impulse)
    return bodies._replace(velocities=scatter_velocities(bodies.velocities, contacts.pair, before, after))


def moved_apart(bodies: Bodies, contacts: Contacts) -> jax.Array:
    """Movement of b against a since the contact was found, [K, 2] m."""
    return pick(contacts.pair.is_b, bodies.delta) - pick(contacts.pair.is_a, bodies.delta)


def arms_now(bodies: Bodies, contacts: Contacts) -> tuple[jax.Array, jax.Array]:
    """Arms from both centres to where impulses act, [K, 2] m each. Where both bodies can move it is one point, wherever
    they have gone since: an impulse at two points would change what both have of angular momentum. What is fixed takes
    any, so that the other's own surface is the point."""
    apart = contacts.gap + moved_apart(bodies, contacts)
    apart = jnp.where(contacts.against_fixed[:, None], 0, apart)
    share = contacts.follows_b[:, None]
    return contacts.arm_a + apart * share, contacts.arm_b - apart * (1 - share)


def arms_of_impact(bodies: Bodies, contacts: Contacts) -> tuple[jax.Array, jax.Array]:
    """`arms_now` of an impact of two polygons: to where both have got and turned since. On what is fixed the point
    stays on the other's surface. A disc has its point below its centre, however it turns."""
    turn_a, turn_b = turned_arms(bodies, contacts)
    gap = contacts.gap + moved_apart(bodies, contacts) + turn_b - turn_a
    along = contacts.normal * vec2.dot(contacts.normal, gap)[:, None]
    gap = jnp.where(contacts.against_fixed[:, None], gap - along, gap)
    share, plain = contacts.follows_b[:, None], contacts.of_disc[:, None]
    of_discs = arms_now(bodies, contacts)
    return (
        jnp.where(plain, of_discs[0], contacts.arm_a + turn_a + gap * share),
        jnp.where(plain, of_discs[1], contacts.arm_b + turn_b - gap * (1 - share)),
    )


def carried_arms(
    bodies: Bodies, contacts: Contacts, arm_a: jax.Array, arm_b: jax.Array, ahead: Scalar
) -> tuple[jax.Array, jax.Array]:
    """`arms_now`, but on a kinematic body to where the other's surface is `ahead` seconds from now: in the middle of a
    sub-step the velocity there is the mean of how the place moves, so that what a turntable carries drifts neither out
    nor in."""
    apart = contacts.gap + moved_apart(bodies, contacts)

    def turned(arm: jax.Array, body: jax.Array) -> jax.Array:
        return arm + vec2.left(arm) * (pick(body, bodies.velocities.omega) * ahead)[:, None]

    pair = contacts.pair
    return (
        jnp.where(contacts.kinematic_a[:, None], turned(arm_a + apart, pair.is_a), arm_a),
        jnp.where(contacts.kinematic_b[:, None], turned(arm_b - apart, pair.is_b), arm_b),
    )


def surface_work(bodies: Bodies, contacts: Contacts, h: Scalar) -> jax.Array:
    """[K] J, what moving surfaces have done to the bodies in this sub-step of h."""
    row = rows_now(bodies, contacts, -0.5 * h)
    on_b = row.normal * row.impulse_normal[:, None] + vec2.right(row.normal) * row.impulse_tangent[:, None]
    of = pair_velocities(row.pair, bodies.velocities)
    by_a = vec2.dot(on_b, of.velocity_a + vec2.left(row.arm_a) * of.omega_a[:, None])
    by_b = vec2.dot(on_b, of.velocity_b + vec2.left(row.arm_b) * of.omega_b[:, None])
    work = jnp.where(contacts.kinematic_a, by_a, 0) - jnp.where(contacts.kinematic_b, by_b, 0)
    if contacts.surface_speed is not None:
        work += contacts.impulse_tangent * contacts.surface_speed * (contacts.key >= 0)
    return work


def current_separation(bodies: Bodies, contacts: Contacts) -> jax.Array:
    """[K] m. Surfaces move and turn with their bodies; the normal stays as it was at the start of the step."""
    (arm_a, arm_b), moved = turned_arms(bodies, contacts), moved_apart(bodies, contacts)
    return contacts.separation + vec2.dot(moved + arm_b - arm_a, contacts.normal)


def turned_arms(bodies: Bodies, contacts: Contacts) -> tuple[jax.Array, jax.Array]:
    """Change of the arms of a and b by turning, [K, 2] m. On a face the point of a disc stays below its centre,
    and those of two discs between their centres: turned with one that rolls it would rise, and the disc sink."""
    turn_b = jnp.where(contacts.disc_on_face | contacts.are_discs, 0, pick(contacts.pair.is_b, bodies.turn))
    turn_a = jnp.where(contacts.are_discs, 0, pick(contacts.pair.is_a, bodies.turn))
    return _turned_by(contacts.arm_a, turn_a), _turned_by(contacts.arm_b, turn_b)


def _turned_by(arm: jax.Array, turn: jax.Array) -> jax.Array:
    """Change of an arm by a turn. 1 - cos is written so that it keeps its digits for small turns."""
    one_minus_cos = 2 * jnp.square(jnp.sin(0.5 * turn))
    return vec2.left(arm) * jnp.sin(turn)[:, None] - arm * one_minus_cos[:, None]


class Given(NamedTuple):
    """Normal impulses that contacts have got in a pass with bias."""

    impulse: jax.Array  # [K] N s, of an impact 0
    slope: jax.Array  # [K] J, it times what was wrong before it, and half of what it changed
    yielded: jax.Array  # [K] J, that its softness takes
    is_hit: jax.Array  # [K] bool, an impact that has changed


def _given(total: jax.Array, wanted: jax.Array, speed: jax.Array, softness: tuple, c: Row) -> Given:
    mass_scale, impulse_scale = softness
    impulse = total - c.impulse_normal
    inverse = jnp.where(c.mass_normal > 0, 1 / jnp.where(c.mass_normal > 0, c.mass_normal * mass_scale, 1), 0)
    yields = impulse_scale * inverse
    wrong = speed + wanted / mass_scale + yields * c.impulse_normal
    slope = impulse * (wrong + 0.5 * impulse * mass_scale * inverse)
    return Given(impulse, slope, yields * impulse * impulse, jnp.zeros_like(impulse, dtype=bool))


def solve_soft(
    bodies: Bodies,
    contacts: Contacts,
    joined: tuple[Joints, PlacedJoints],
    params: SolverNumbers,
    active: ActiveSet,
    *,
    use_bias: bool,
) -> tuple[Bodies, Contacts, Joints, jax.Array, Given]:
    """One pass of the soft-step solver. With bias: pushes out of penetration softly; without (relax): takes back the
    velocity that the push added, and applies friction. `joined`: joints, which answer to impacts at once, and where
    they are. Also the bodies [n] whose impacts are to be shared out, and what contacts got."""
    separation = current_separation(bodies, contacts)
    is_apart = separation > C.touching_distance
    bias = jnp.where(is_apart, separation / params.h, 0)  # speculative: may close the gap, not more
    mass_scale, impulse_scale = jnp.ones_like(separation), jnp.zeros_like(separation)
    if use_bias:
        soft = jax.tree.map(
            lambda fixed, free: jnp.where(contacts.against_fixed, fixed, free), params.fixed, params.contact
        )
        push = jnp.maximum(soft.mass_scale * soft.bias_rate * separation, -params.push_out_speed)
        bias = jnp.where(is_apart, bias, push)
        mass_scale = jnp.where(is_apart, mass_scale, soft.mass_scale)
        impulse_scale = jnp.where(is_apart, impulse_scale, soft.impulse_scale)
    included = active.includes(contacts.pair)
    shares = active.shares(contacts.pair)
    large = jnp.where(shares, C.settled_speed, C.shared_speed)
    contacts = contacts._replace(is_impact=contacts.is_impact | shares)

    ahead = 0.5 * params.h if use_bias else -0.5 * params.h  # with bias the sub-step is to come, without it is past
    answers = joints_of.answers(bodies, *joined, marked(bodies, contacts.pair, contacts.is_impact & included))

    def solve(carry: tuple[Velocities, jax.Array, Impact], row: tuple) -> tuple[tuple, tuple]:
        velocities, joint_impulses, first = carry
        c, bias, mass_scale, impulse_scale, face, is_impact, is_second, included, large, answer = row
        before = pair_velocities(c.pair, velocities)
        wanted = bias + closes_by(before, c, face)
        impulse = -c.mass_normal * (mass_scale * normal_speed(before, c) + wanted) - impulse_scale * c.impulse_normal
        of, normal_total = push_apart(before, c, impulse)
        given = _given(normal_total, wanted, normal_speed(before, c), (mass_scale, impulse_scale), c)
        tangent_total, rolling_total = c.impulse_tangent, c.rolling_impulse
        if not use_bias:
            of, tangent_total = solve_friction(of, c, normal_total)
        own = solve_impact(before, Impact(c, face, bias, answer, pushed=jnp.zeros(6, bias.dtype), change=bias * 0))
        first = first._replace(pushed=jnp.zeros(6, bias.dtype))
        agreed, first, own = solve_both_points(own[0], first, own[1], is_second & is_impact & included)
        pushed = jnp.where(is_impact & included, first.pushed + own.pushed, 0)
        impact = (agreed, own.contact.impulse_normal, own.contact.impulse_tangent)
        of, normal_total, tangent_total = choose(is_impact, impact, (of, normal_total, tangent_total))
        if not use_bias:
            of, rolling_total = solve_rolling(of, c, normal_total)
        totals = (normal_total, tangent_total, rolling_total)
        of, totals = choose(included, (of, totals), (before, (c.impulse_normal, c.impulse_tangent, c.rolling_impulse)))
        velocities = scatter_velocities(velocities, c.pair, before, of)
        velocities, joint_impulses = joints_of.answer(answers, velocities, joint_impulses, c.pair, pushed)
        of_first = (first.contact.impulse_normal, first.contact.impulse_tangent)
        none = jax.tree.map(jnp.zeros_like, given)
        given = choose(is_impact, none._replace(is_hit=own.change > 0), given)
        given = choose(included, given, none)
        changed = included & is_impact & (own.change > large)
        return (velocities, joint_impulses, own), (*totals, *of_first, changed, given)

    rows = rows_now(bodies, contacts, ahead)
    is_placed = (contacts.is_impact & ~contacts.kinematic_a & ~contacts.kinematic_b)[:, None]
    arm_a, arm_b = choose(is_placed, arms_of_impact(bodies, contacts), (rows.arm_a, rows.arm_b))
    rows = rows._replace(arm_a=arm_a, arm_b=arm_b)
    foreseen = use_bias & (~contacts.of_disc | contacts.disc_on_face)
    face = Face(
        is_of_a=contacts.follows_b > 0.5,
        below_disc=contacts.disc_on_face,
        seconds=jnp.where(foreseen, 0.5 * params.h, 0),
        mass_scale=mass_scale,
        max_spin=jnp.full_like(separation, params.max_angular_speed),
    )
    of_pairs = joints_of.answers_of_pairs(answers, contacts.pair)
    none = jax.tree.map(lambda x: jnp.zeros_like(x[0]), Impact(rows, face, bias, of_pairs, of_pairs[:, 0], bias))
    xs = (
        rows,
        bias,
        mass_scale,
        impulse_scale,
        face,
        contacts.is_impact,
        contacts.is_second,
        included,
        large,
        of_pairs,
    )
    (velocities, joint_impulses, _), solved = jax.lax.scan(
        solve, (bodies.velocities, joints_of.row_impulses(joined[0]), none), xs
    )
    normal, tangent, rolling, first_normal, first_tangent, changed, given = solved
    # The second of two points has changed the first's as well.
    both = jnp.roll(contacts.is_second & contacts.is_impact & included, -1)
    normal = jnp.where(both, jnp.roll(first_normal, -1), normal)
    tangent = jnp.where(both, jnp.roll(first_tangent, -1), tangent)
    contacts = contacts._replace(rolling_impulse=rolling)
    return (
        bodies._replace(velocities=velocities),
        with_impulses(contacts, normal, tangent),
        joints_of.with_changed_impulses(joined[0], joint_impulses),
        marked(bodies, contacts.pair, changed),
        given,
    )


class Face(NamedTuple):
    """The face of a contact, which turns with its body."""

    is_of_a: jax.Array  # bool, else b's
    below_disc: jax.Array  # bool, b is a disc on it
    seconds: jax.Array  # s that are foreseen, half of a sub-step; 0: not
    mass_scale: jax.Array  # of the softness
    max_spin: jax.Array  # rad/s; faster nothing turns in the end, however fast it does while velocities are solved


def closes_by(of: PairVelocities, c: Row, face: Face) -> jax.Array:
    """m/s by which a face that turns closes on what slides along it, which would go straight on, negative; 0 where it
    opens, or closes by less than what rests may move. The normal turns with the body of the face, and a corner with its
    own; the point of a disc stays below its centre."""
    is_a, below_disc = face.is_of_a[..., None], face.below_disc[..., None]
    spin = jnp.clip(jnp.where(face.is_of_a, of.omega_a, of.omega_b), -face.max_spin, face.max_spin)
    of_corner = jnp.where(is_a, vec2.left(c.arm_b) * of.omega_b[..., None], vec2.left(c.arm_a) * -of.omega_a[..., None])
    velocity = of.velocity_b - of.velocity_a + jnp.where(below_disc, 0, of_corner)
    from_face = jnp.where(is_a, c.arm_a, -c.arm_b) - jnp.where(below_disc, c.arm_b, 0)
    rate = 2 * spin * vec2.dot(vec2.left(c.normal), velocity) - spin * spin * vec2.dot(c.normal, from_face)
    speed = face.seconds * rate
    return face.mass_scale * jnp.where(speed < -C.resting_speed, speed, 0)


class Impact(NamedTuple):
    """A contact whose normal impulse and friction are solved together."""

    contact: Row
    face: Face
    bias: jax.Array
    answer: jax.Array  # [6, 6] of joints to a change of the velocities of its bodies
    pushed: jax.Array  # [6] m/s and rad/s, what its impulses have changed of them, without that
    change: jax.Array  # m/s, largest by which solving it changed a speed


def solve_both_points(
    of: PairVelocities, first: Impact, second: Impact, are_both: jax.Array
) -> tuple[PairVelocities, Impact, Impact]:
    """Solves both points of a pair in turn, until they agree; each has been solved once."""

    def one_round(now: tuple, _: None) -> tuple[tuple, None]:
        of, first, second = now
        unsettled = are_both & (jnp.maximum(first.change, second.change) > C.settled_speed)
        after, first_after = solve_impact(of, first)
        after, second_after = solve_impact(after, second)
        return choose(unsettled, (after, first_after, second_after), now), None

    def rounds() -> tuple:
        return jax.lax.scan(one_round, (of, first, second), length=C.point_rounds)[0]

    worst = jnp.maximum(first.change, second.change)
    return jax.lax.cond(in_any_world(are_both & (worst > C.settled_speed)), rounds, lambda: (of, first, second))


def solve_impact(of: PairVelocities, impact: Impact) -> tuple[PairVelocities, Impact]:
    """Normal and friction of an impact together, as each changes the other's speed: it sticks, or slides at Coulomb's
    limit. What is jointed to its bodies answers at once."""
    c = impact.contact
    tangent = vec2.right(c.normal)
    v = relative_velocity(of, c.arm_a, c.arm_b)
    vn, vt = vec2.dot(c.normal, v) + impact.bias + closes_by(of, c, impact.face), vec2.dot(tangent, v)
    if c.surface_speed is not None:
        vt -= c.surface_speed
    rest = jax.tree.map(jnp.zeros_like, of)
    by_n, by_t = (joints_of.as_vector(apply_impulse(rest, c.pair, c.arm_a, c.arm_b, d)) for d in (c.normal, tangent))

    def answered(pushed: jax.Array) -> PairVelocities:
        return joints_of.as_velocities(pushed + joint_system.times(impact.answer, pushed))

    of_n, of_t = (relative_velocity(answered(by), c.arm_a, c.arm_b) for by in (by_n, by_t))
    knn, knt, ktt = vec2.dot(c.normal, of_n), vec2.dot(tangent, of_n), vec2.dot(tangent, of_t)
    determinant = knn * ktt - knt * knt
    inverse = jnp.where(determinant != 0, 1 / jnp.where(determinant != 0, determinant, 1), 0)
    n = c.impulse_normal - inverse * (ktt * vn - knt * vt)
    t = c.impulse_tangent - inverse * (knn * vt - knt * vn)
    slides = (n < 0) | (jnp.abs(t) > c.friction * n)
    # It slides, and friction is mu times what the normal impulse then is: on the way from none to what would stop it.
    closing = knn * c.impulse_normal + knt * c.impulse_tangent - vn  # without its impulses
    side = jnp.where(t > 0, c.friction, -c.friction)
    k = knn + side * knt
    sliding = jnp.where((closing > 0) & (k > 0), closing / jnp.where(k > 0, k, 1), 0)
    n, t = jnp.where(slides, sliding, n), jnp.where(slides, side * sliding, t)
    # Friction could hold what opens by itself (Painleve's paradox): it has no impulse.
    opens = (c.impulse_normal == 0) & (c.impulse_tangent == 0) & (vn >= 0)
    n, t = jnp.where(opens, 0, n), jnp.where(opens, 0, t)
    added_n, added_t = n - c.impulse_normal, t - c.impulse_tangent
    pushed = added_n * by_n + added_t * by_t
    of = jax.tree.map(jnp.add, of, answered(pushed))
    change = jnp.maximum(jnp.abs(added_n) * knn, jnp.abs(added_t) * ktt)
    solved = c._replace(impulse_normal=n, impulse_tangent=t)
    return of, impact._replace(contact=solved, pushed=impact.pushed + pushed, change=change)


def normal_speed(of: PairVelocities, c: Row) -> jax.Array:
    return vec2.dot(c.normal, relative_velocity(of, c.arm_a, c.arm_b))


def push_apart(of: PairVelocities, c: Row, impulse: jax.Array) -> tuple[PairVelocities, jax.Array]:
    """Adds a normal impulse, as far as the accumulated one stays positive; also the new total."""
    total = jnp.maximum(c.impulse_normal + impulse, 0)
    return apply_impulse(of, c.pair, c.arm_a, c.arm_b, c.normal * (total - c.impulse_normal)[..., None]), total


class Row(NamedTuple):
    """A contact as solving it needs it."""

    pair: Pair
    normal: jax.Array
    arm_a: jax.Array
    arm_b: jax.Array
    mass_normal: jax.Array
    mass_tangent: jax.Array
    impulse_normal: jax.Array
    impulse_tangent: jax.Array
    friction: jax.Array
    surface_speed: jax.Array | None  # of extended shapes
    rolling_arm: jax.Array | None
    rolling_impulse: jax.Array | None


def rows_of(contacts: Contacts) -> Row:
    return Row(*(getattr(contacts, name) for name in Row._fields))


def rows_now(bodies: Bodies, contacts: Contacts, ahead: Scalar) -> Row:
    """Rows as the bodies stand now; `rows_of` has them as they stood when the contacts were found. `ahead` [] s: see
    `carried_arms`."""
    arm_a, arm_b = carried_arms(bodies, contacts, *arms_now(bodies, contacts), ahead)
    return rows_of(contacts)._replace(
        arm_a=arm_a,
        arm_b=arm_b,
        mass_normal=pair_mass(contacts.pair, arm_a, arm_b, contacts.normal),
        mass_tangent=pair_mass(contacts.pair, arm_a, arm_b, vec2.right(contacts.normal)),
    )


def with_impulses(contacts: Contacts, normal: jax.Array, tangent: jax.Array) -> Contacts:
    max_impulse = jnp.maximum(contacts.max_impulse, normal)
    return contacts._replace(impulse_normal=normal, impulse_tangent=tangent, max_impulse=max_impulse)


def solve_friction(of: Any, c: Row, normal_total: jax.Array) -> tuple[Any, jax.Array]:
    tangent = vec2.right(c.normal)
    vt = vec2.dot(tangent, relative_velocity(of, c.arm_a, c.arm_b))
    if c.surface_speed is not None:
        vt -= c.surface_speed
    max_friction = c.friction * normal_total
    total = jnp.clip(c.impulse_tangent - c.mass_tangent * vt, -max_friction, max_friction)
    total = jnp.where(c.friction == 0, c.impulse_tangent, total)
    return apply_impulse(of, c.pair, c.arm_a, c.arm_b, tangent * (total - c.impulse_tangent)[..., None]), total


def solve_rolling(of: Any, c: Row, normal_total: jax.Array) -> tuple[Any, jax.Array | None]:
    """A torque against the spin of one on the other, of at most the normal force times `rolling_arm`."""
    if c.rolling_arm is None or c.rolling_impulse is None:
        return of, None
    inertia = vec2.inverse_or_zero(c.pair.inertia_a + c.pair.inertia_b)
    most = c.rolling_arm * normal_total
    total = jnp.clip(c.rolling_impulse - inertia * (of.omega_b - of.omega_a), -most, most)
    return apply_angular_impulse(of, c.pair, total - c.rolling_impulse), total
