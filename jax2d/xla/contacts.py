"""The contacts of one world in one step: found, and matched with the impulses of the step before."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import Capacity, Scene
from jax2d.solver_numbers import Scalar, SolverNumbers
from jax2d.xla import vec2
from jax2d.xla.active_set import has_one_of
from jax2d.xla.bodies import Bodies, Pair, pair_mass, pair_up, pair_velocities, relative_velocity
from jax2d.xla.geometry import Geometry
from jax2d.xla.manifolds import Points
from jax2d.xla.pairs import collide, pair_list
from jax2d.xla.prediction import TravelPrediction, margins, predict_travel, predicted_travel
from jax2d.xla.rules import Rules


class Contacts(NamedTuple):
    """`K` slots; those in use come first, in the order of pairs, and are solved in this order."""

    key: jax.Array  # [K] int32, -1 where free
    pair: Pair  # of [K]
    normal: jax.Array  # [K, 2]
    arm_a: jax.Array  # [K, 2] m, from the centres of mass to both surfaces, at the start of the step
    arm_b: jax.Array
    gap: jax.Array  # [K, 2] m, from a's surface to b's where they will meet, at the start of the step
    follows_b: jax.Array  # [K] share by which the common point goes with b; the rest goes with a
    are_discs: jax.Array  # [K] bool, both
    disc_on_face: jax.Array  # [K] bool, b is a disc on a face of a
    separation: jax.Array  # [K] m, at the start of the step
    mass_normal: jax.Array  # [K] kg
    mass_tangent: jax.Array
    impulse_normal: jax.Array  # [K] N s
    impulse_tangent: jax.Array
    surface_speed: (
        jax.Array | None
    )  # [K] m/s along the tangent, at which b shall go against a; None: no extended shapes
    rolling_arm: jax.Array | None  # [K] m, largest torque a normal force
    rolling_impulse: jax.Array | None  # [K] N m s
    friction: jax.Array  # [K]
    restitution: jax.Array
    approach: jax.Array  # [K] m/s, relative normal speed before solving, negative when approaching
    max_impulse: jax.Array  # [K] N s, largest normal impulse in this step
    against_fixed: jax.Array  # [K] bool, one of the two cannot be pushed
    kinematic_a: jax.Array  # [K] bool, a cannot be pushed and moves
    kinematic_b: jax.Array
    is_impact: jax.Array  # [K] bool, they meet fast, and were apart before
    is_second: jax.Array  # [K] bool, of two points of one pair
    of_disc: jax.Array  # [K] bool, b is a disc: the two meet in one point
    overflow: jax.Array  # [] int32, points that found no slot
    unsteady: jax.Array  # [n] bool, their contacts do not hold for the whole step: they turn or hit too fast
    predicted: TravelPrediction


class ContactCache(NamedTuple):
    """Impulses of the contacts of one step, by key, for warm starting those of the next."""

    key: jax.Array  # [K] int32
    impulse: jax.Array  # [K, 2] N s
    rolling: jax.Array | None = None  # [K] N m s, of extended shapes


def cache_of(contacts: Contacts, transient: jax.Array | bool = False) -> ContactCache:
    """Impulses for warm starting, none of what does not last, [K]."""
    impulse = jnp.stack([contacts.impulse_normal, contacts.impulse_tangent], -1)
    rolling = contacts.rolling_impulse
    rolling = None if rolling is None else jnp.where(transient, 0, rolling)
    return ContactCache(contacts.key, jnp.where(jnp.asarray(transient)[..., None], 0, impulse), rolling)


def reset_impulses(contacts: Contacts, which: jax.Array) -> Contacts:
    """Contacts with zero impulses where `which` [K] bool is True."""
    rolling = contacts.rolling_impulse
    return contacts._replace(
        impulse_normal=jnp.where(which, 0, contacts.impulse_normal),
        impulse_tangent=jnp.where(which, 0, contacts.impulse_tangent),
        rolling_impulse=None if rolling is None else jnp.where(which, 0, rolling),
    )


class Context(NamedTuple):
    """Inputs that do not change in a step."""

    scene: Scene
    params: SolverNumbers
    rules: Rules
    capacity: Capacity


class PointsInUse(NamedTuple):
    """Contact points [K] that exist, first and in order of pairs, their shapes, and fields of `Contacts`."""

    points: Points
    a: jax.Array  # [K] int32
    b: jax.Array
    overflow: jax.Array
    unsteady: jax.Array
    predicted: TravelPrediction


def find(
    bodies: Bodies,
    geometry: Geometry,
    cache: ContactCache,
    context: Context,
    dt: Scalar,
    is_start: jax.Array | bool = True,
    which: jax.Array | None = None,
) -> Contacts:
    """Points of all pairs that may touch within `dt`, compacted into the slots of `cache`. `is_start` [] bool: nothing
    has acted yet in this sub-step. `which` [n] bool: of these alone, with each other and what is fixed."""
    found = _points_in_use(bodies, geometry, context, dt, slots=cache.key.shape[0], which=which)
    return from_points(found, bodies, geometry, cache, context, dt, is_start)


def from_points(
    found: PointsInUse,
    bodies: Bodies,
    geometry: Geometry,
    cache: ContactCache,
    context: Context,
    dt: Scalar,
    is_start: jax.Array | bool = True,
) -> Contacts:
    """Contacts at points that were found, with the impulses of the step before."""
    scene, params, rules, _ = context
    points, a, b, overflow, unsteady, predicted = found
    pair = pair_up(bodies, a, b, points.exists)
    friction_a, friction_b = scene.shapes.friction[a], scene.shapes.friction[b]
    restitution = jnp.minimum(scene.shapes.restitution[a], scene.shapes.restitution[b])
    # Where the surfaces are apart each is met at its own point: they will have moved together by then.
    half_gap = points.normal * (0.5 * jnp.maximum(points.separation, 0))[:, None]
    arm_a = points.point - half_gap
    # Nothing turns a disc about its own centre by pushing it along the line to another's: until they meet they are
    # beside that line, and are there when they do.
    d, are_discs = bodies.position[b] - bodies.position[a], a >= context.capacity.polygons
    met = jnp.where((are_discs & rules.is_soft)[:, None], points.normal * vec2.dot(points.normal, d)[:, None], d)
    arm_b = points.point + half_gap - met
    key = jnp.where(points.exists, (a << C.feature_bits + C.shape_bits) | (b << C.feature_bits) | points.feature, -1)
    velocity = relative_velocity(pair_velocities(pair, bodies.velocities), arm_a, arm_b)
    against_fixed = ~(bodies.is_dynamic[a] & bodies.is_dynamic[b])
    approach = vec2.dot(points.normal, velocity)
    # What an impact next to it has left of an impulse would throw apart what it no longer holds.
    is_lasting = (params.warm_start > 0) & ~(rules.is_soft & is_start & (approach > C.min_separating_speed))
    impulse = jnp.where(is_lasting[:, None], _cached_impulses(key, cache, cache.impulse), 0)
    pair_key = key >> C.feature_bits
    is_second = points.exists & (pair_key == jnp.roll(pair_key, 1)) & (jnp.arange(len(key)) > 0) & rules.is_soft
    # Discs have no corners to turn about: theirs are handed on (`impact_passes`) or left to the next sub-step.
    can_impact = points.exists & rules.is_soft & ((rules.impact_passes > 0) | (b < context.capacity.polygons))
    is_impact = (approach < -C.min_impact_speed) & (impulse[:, 0] == 0) & can_impact
    is_impact |= (is_second & jnp.roll(is_impact, 1)) | jnp.roll(is_second & is_impact, -1)  # both points or none
    if rules.is_soft:
        hard = _hits_hard(points, approach, geometry.core[a], geometry.core[b], params, dt)
        bounces = are_discs & ~against_fixed & hits(restitution, approach, params)
        of_centres = bodies.velocities.velocity[b] - bodies.velocities.velocity[a]
        bounces &= _meet_aside(points, approach, of_centres, d, dt)
        is_unsteady = points.exists & (hard | bounces)
        unsteady |= jnp.any((pair.is_a | pair.is_b) & is_unsteady[:, None], axis=0) & bodies.moves
    return Contacts(
        key=key,
        pair=pair,
        normal=points.normal,
        arm_a=arm_a,
        arm_b=arm_b,
        follows_b=points.follows_b,
        gap=2 * half_gap + d - met,
        disc_on_face=points.on_face,
        are_discs=are_discs & points.exists,
        separation=points.separation,
        mass_normal=pair_mass(pair, arm_a, arm_b, points.normal),
        mass_tangent=pair_mass(pair, arm_a, arm_b, vec2.right(points.normal)),
        impulse_normal=impulse[:, 0],
        impulse_tangent=impulse[:, 1],
        **_of_extended_shapes(scene, a, b, key, cache, is_lasting),
        friction=mix_friction(friction_a, friction_b, params, rules),
        restitution=restitution,
        approach=approach,
        max_impulse=jnp.zeros_like(points.separation),
        against_fixed=against_fixed,
        is_impact=is_impact,
        is_second=is_second,
        of_disc=points.exists & (b >= context.capacity.polygons),
        kinematic_a=bodies.is_kinematic[a] & points.exists,
        kinematic_b=bodies.is_kinematic[b] & points.exists,
        overflow=overflow,
        unsteady=unsteady,
        predicted=predicted,
    )


def _points_in_use(
    bodies: Bodies,
    geometry: Geometry,
    context: Context,
    dt: Scalar,
    *,
    slots: int,
    which: jax.Array | None = None,
) -> PointsInUse:
    scene, params, rules, capacity = context
    predicted = predict_travel(bodies, geometry, dt)
    is_soft = rules.is_soft
    reach = params.speculative_distance if is_soft else 0.0
    if capacity.shapes == 1:  # no pair at all, one slot
        zeros, none = jnp.zeros((slots, 2), bodies.position.dtype), jnp.zeros(slots, jnp.int32)
        points = Points(zeros, zeros, zeros[:, 0], none, zeros[:, 0], none > 0, none > 0)
        return PointsInUse(points, none, none, none[0], jnp.zeros_like(bodies.moves), predicted)
    pairs = pair_list(capacity)
    margin = margins(predicted, reach, ahead=is_soft)
    points = collide(geometry, bodies, capacity, margin, dt, params.h, rules)
    # Contact points and normals hold for small turns only: a rod that spins fast sweeps over what they say.
    # So does a bar along which something fast goes meanwhile.
    turn = jnp.where(predicted.arm > 0, jnp.abs(bodies.velocities.omega * dt), 0)
    rotates_too_far = is_soft & (predicted_travel(predicted) * jnp.maximum(turn[:, None], turn[None]) > reach)
    one, other = pairs.point_a, pairs.point_b
    exists = points.exists & scene.shapes.can_touch[one, other]
    if which is not None:
        can_be = which | ~bodies.moves
        exists &= can_be[one] & can_be[other] & (which[one] | which[other])
    is_unsteady = exists & rotates_too_far[one, other]
    unsteady = jnp.zeros_like(bodies.moves).at[one].max(is_unsteady).at[other].max(is_unsteady) & bodies.moves
    source = jnp.argsort(~exists, stable=True)[:slots]
    points = jax.tree.map(lambda x: x[source], points._replace(exists=exists))
    overflow = jnp.maximum(jnp.sum(exists, dtype=jnp.int32) - slots, 0)
    a, b = jnp.asarray(pairs.point_a)[source], jnp.asarray(pairs.point_b)[source]
    return PointsInUse(points, a, b, overflow, unsteady, predicted)


def replace_found(old: Contacts, new: Contacts, which: jax.Array) -> Contacts:
    """Contacts that were found for the bodies of `which` [n] bool in place of theirs; others stay."""
    slots = new.key.shape[0]
    stays = has_one_of(old.pair, ~which) & ~has_one_of(old.pair, which)
    key = jnp.concatenate([old.key, new.key])
    in_use = jnp.concatenate([stays, new.key >= 0])
    free = jnp.concatenate([jnp.zeros_like(stays), new.key < 0])
    last = jnp.iinfo(key.dtype).max
    source = jnp.argsort(jnp.where(in_use, key >> C.feature_bits, jnp.where(free, last - 1, last)), stable=True)[:slots]
    per_world = {"overflow", "unsteady", "predicted"}
    rows = {
        name: jax.tree.map(lambda x, y: jnp.concatenate([x, y])[source], getattr(old, name), getattr(new, name))
        for name in Contacts._fields
        if name not in per_world
    }
    by_body = (
        jnp.where(which[:, None] if x.ndim == 2 else which, x, y)
        for x, y in zip(new.predicted, old.predicted, strict=True)
    )
    predicted = TravelPrediction(*by_body)._replace(apart=new.predicted.apart)
    overflow = new.overflow + jnp.maximum(jnp.sum(in_use, dtype=jnp.int32) - slots, 0)
    return Contacts(**rows, overflow=overflow, unsteady=new.unsteady, predicted=predicted)


def _hits_hard(
    points: Points, approach: jax.Array, core_a: jax.Array, core_b: jax.Array, params: SolverNumbers, dt: Scalar
) -> jax.Array:
    """[K] bool, approaches so fast that it would go through the thinner of the two in the rest of the step: it then
    moves on in ways that no prediction has, around a corner or over an end."""
    thin = C.safe_core_share * jnp.minimum(core_a, core_b)
    return -approach * dt > jnp.maximum(points.separation, 0) + params.speculative_distance + thin


def hits(restitution: jax.Array, approach: jax.Array, params: SolverNumbers) -> jax.Array:
    """Returns True where a contact meets so fast that it bounces."""
    return (restitution > 0) & (approach <= -params.restitution_threshold)


def _meet_aside(points: Points, approach: jax.Array, velocity: jax.Array, d: jax.Array, dt: Scalar) -> jax.Array:
    """Returns True where discs meet in the rest of the step and are beside each other's line when it ends: an impulse
    would act at one point of both then, and turn them. d, velocity [K, 2]: of b against a."""
    aside = jnp.abs(vec2.cross(points.normal, velocity))
    return (-approach * dt > points.separation) & (aside * dt > C.aside_share * vec2.dot(points.normal, d))


def _of_extended_shapes(
    scene: Scene, a: jax.Array, b: jax.Array, key: jax.Array, cache: ContactCache, is_lasting: jax.Array
) -> dict[str, jax.Array | None]:
    """Fields of `Contacts` that only a capacity with extended shapes has."""
    shapes = scene.shapes
    if cache.rolling is None:
        return dict.fromkeys(("surface_speed", "rolling_arm", "rolling_impulse"))
    share = jnp.maximum(shapes.rolling_resistance[a], shapes.rolling_resistance[b])
    radius = jnp.concatenate([jnp.zeros(shapes.num_vertices.shape[0], share.dtype), shapes.radius])  # of what can roll
    cached = _cached_impulses(key, cache, cache.rolling[:, None])[:, 0]
    return {
        "surface_speed": shapes.surface_speed[a] + shapes.surface_speed[b],
        "rolling_arm": share * jnp.maximum(radius[a], radius[b]),
        "rolling_impulse": jnp.where(is_lasting, cached, 0),
    }


def _cached_impulses(key: jax.Array, cache: ContactCache, impulses: jax.Array) -> jax.Array:
    """Impulses [K, m] that the step before cached under these keys, zero for new contacts."""
    is_same = (key[:, None] == cache.key[None]) & (key[:, None] >= 0)
    old = impulses[jnp.argmax(is_same, axis=1)]
    return jnp.where(jnp.any(is_same, axis=1)[:, None], old, 0)


def mix_friction(a: jax.Array, b: jax.Array, params: SolverNumbers, rules: Rules) -> jax.Array:
    mixed = a * a + b * b if rules.friction_mixing == "root_sum_square" else a * b
    return params.base_friction * vec2.sqrt_or_zero(mixed)
