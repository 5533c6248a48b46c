"""Pixel observations: the picture of a world, [W, 125, 125, 3] uint8, as `jax2d.draw` paints it (`rasteriser.py`).

    floor and whatever is fixed   painted once a level, `PixelStatic.background`
    what moves                    painted over it whenever a policy looks, from where bodies are (12 bytes a shape)

So a rollout stores 84 to 192 bytes a world and step, where a picture has 46,875; frames are uint8 when a policy takes
them, and no longer kept than it needs. Shapes are in the colours of their roles, fixed ones darker; motors and
thrusters in the colours of the actions that drive them, since nothing else says which these are; a motor that runs by
itself in that of outlines.

View: 5 x 5 m, 25 pixels a metre, x to the right and y up (row 0 is the top). What a picture does not show: velocities,
gravity, strengths of motors and thrusters, limits of joints, friction.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import palette
from jax2d.scene import Array, JointKind
from kinetix_dist.env.observations.observation import IMAGE, Moving, Observation
from kinetix_dist.env.observations.rasteriser import (
    PIXELS,
    Primitive,
    blank,
    edges_of,
    line_edges,
    paint,
    turn,
    unpack,
)
from kinetix_dist.level.level import NUM_WALLS, Level

_LINE_M = palette.LINE_WIDTH / 100  # at the 100 pixels a metre of which these are pixels
_WELD_M = palette.WELD_WIDTH / 100
FAR_M = 1e4  # outside of every picture, and its square is a number


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PixelStatic:
    """Part of a picture that a level fixes."""

    background: Array  # [W, 125, 125] uint32, packed: all that never moves
    colours: Array  # [W, n, 3] float32 0..255, of shapes
    moves: Array  # [W, n] float32, 1: painted with every picture
    edges: Array  # [W, P, V, 3] of polygons, in their own frame
    radius: Array  # [W, C] m
    joint_active: Array  # [W, J] float32
    joint_kind: Array  # [W, J] int32
    joint_a: Array  # [W, J] int32
    joint_b: Array  # [W, J] int32
    anchor_a: Array  # [W, J, 2] m
    anchor_b: Array  # [W, J, 2] m
    rail: Array  # [W, J, 3] angle of the axis in the frame of a; lower and upper end, m along it
    rail_follows: Array  # [W, J] bool, the rail has no ends: it is shown where b is
    motor_on: Array  # [W, J] float32
    motor_colour: Array  # [W, J, 3] float32 0..255
    thruster_active: Array  # [W, T] float32
    thruster_body: Array  # [W, T] int32
    thruster_edges: Array  # [W, T, 3, 3] in the frame of the body
    thruster_colour: Array  # [W, T, 3]


class PixelObservation(Observation):
    """The picture of a world."""

    gives = IMAGE
    entries = {"": ("position_x", "position_y", "angle")}
    working_bytes = PIXELS**2 * (4 + 4 + 4 + 3)  # background, picture as words, the bytes of these, three of them

    def static(self, levels: Level) -> PixelStatic:
        return static_picture(levels)

    def dynamic(self, moving: Moving) -> Array:
        """[W, n, 3] float32: position 2, angle."""
        return jnp.concatenate([moving.position, moving.angle[..., None]], axis=-1).astype(jnp.float32)

    def join(self, static: PixelStatic, dynamic: Array) -> Array:
        return picture(static, dynamic)


@jax.jit
def picture(static: PixelStatic, poses: Array) -> Array:
    """[..., 125, 125, 3] uint8. poses [..., n, 3] may have leading axes more than `static`, such as time."""
    leading = poses.shape[:-2]
    num_worlds_axes = static.moves.ndim - 1
    static = jax.tree.map(lambda x: jnp.broadcast_to(x, leading + x.shape[num_worlds_axes:]), static)
    poses = _in_reach(poses)
    position, angle = poses[..., :2], poses[..., 2]
    layers = [
        *_shapes(static, position, angle, static.moves, first=NUM_WALLS),
        *_thrusters(static, position, angle),
        *_joints(static, position, angle),
    ]
    return unpack(paint(layers, static.background))


def _in_reach(poses: Array) -> Array:
    """A body that has diverged is nowhere to be seen: its place is taken for one far outside of the view."""
    is_near = jnp.all(jnp.abs(poses) < FAR_M, axis=-1, keepdims=True)  # false for NaN
    return jnp.where(is_near, poses, FAR_M)


@jax.jit
def static_picture(levels: Level) -> PixelStatic:
    """levels: [W, ...] on every field."""
    scene, shapes, joints = levels.scene, levels.scene.shapes, levels.scene.joints
    has_no_mass = jnp.asarray(shapes.inverse_mass) == 0
    is_fixed = has_no_mass & ~jnp.asarray(shapes.kinematic)
    active = jnp.asarray(shapes.active, jnp.float32)
    shade = jnp.where(is_fixed, palette.FIXED_SHADE, jnp.where(has_no_mass, palette.KINEMATIC_SHADE, 1.0))
    role_colours = jnp.asarray(palette.ROLE_PALETTE, jnp.float32)
    static = PixelStatic(
        background=blank(is_fixed.shape[:1]),
        colours=jnp.floor(role_colours[levels.shape_role] * shade[..., None]),
        moves=active * ~is_fixed,
        edges=edges_of(_used_vertices(shapes.vertices, shapes.num_vertices)),
        radius=jnp.asarray(shapes.radius),
        joint_active=jnp.asarray(joints.active, jnp.float32),
        joint_kind=jnp.asarray(joints.kind),
        joint_a=jnp.asarray(joints.a),
        joint_b=jnp.asarray(joints.b),
        anchor_a=jnp.asarray(joints.anchor_a),
        anchor_b=jnp.asarray(joints.anchor_b),
        rail=_rails(levels),
        rail_follows=~jnp.asarray(joints.has_limits),
        motor_on=jnp.asarray(joints.motor_on, jnp.float32),
        motor_colour=_motor_colours(levels),
        thruster_active=jnp.asarray(scene.thrusters.active, jnp.float32),
        thruster_body=jnp.asarray(scene.thrusters.body),
        thruster_edges=_nozzles(levels),
        thruster_colour=jnp.asarray(palette.THRUSTER_PALETTE, jnp.float32)[levels.thruster_colour],
    )
    fixed = _shapes(static, jnp.asarray(levels.position), jnp.asarray(levels.angle), active * is_fixed, first=0)
    return dataclasses.replace(static, background=paint(fixed, static.background))


def _motor_colours(levels: Level) -> Array:
    """[W, J, 3] float32 0..255: that of the action that drives a motor, ink where it runs by itself."""
    of_actions = jnp.asarray(palette.MOTOR_PALETTE, jnp.float32)[levels.motor_colour]
    return jnp.where(jnp.asarray(levels.motor_auto)[..., None], jnp.asarray(palette.INK, jnp.float32), of_actions)


def _used_vertices(vertices: Array, num_vertices: Array) -> Array:
    """[..., V, 2] with the last vertex repeated in slots that are not used."""
    number = jnp.minimum(jnp.arange(vertices.shape[-2]), jnp.asarray(num_vertices)[..., None] - 1)
    return jnp.take_along_axis(jnp.asarray(vertices), number[..., None], axis=-2)


def _rails(levels: Level) -> Array:
    joints = levels.scene.joints
    limits = (
        jnp.where(joints.has_limits, joints.lower_limit, -palette.RAIL_M),
        jnp.where(joints.has_limits, joints.upper_limit, palette.RAIL_M),
    )
    return jnp.stack([jnp.asarray(joints.axis_angle), *limits], axis=-1)


def _nozzles(levels: Level) -> Array:
    thrusters, length = levels.scene.thrusters, palette.THRUSTER_LENGTH_M
    half = palette.NOZZLE_SHARE * length
    corners = np.array([[0.0, -half], [length, 0.0], [0.0, half]], np.float32)
    edges = jnp.broadcast_to(edges_of(jnp.asarray(corners)), (*thrusters.active.shape, 3, 3))
    return turn(edges, jnp.asarray(thrusters.angle), jnp.asarray(thrusters.position))


def _shapes(static: PixelStatic, position: Array, angle: Array, opacity: Array, *, first: int) -> list[Primitive]:
    """Polygons from slot `first` on, then circles with a spoke each that says how far they have rolled."""
    num_polygons, num_shapes = static.edges.shape[-3], static.moves.shape[-1]
    layers = []
    for i in range(first, num_shapes):
        colour, outline = static.colours[..., i, :], static.colours[..., i, :] * palette.OUTLINE_SHADE
        place, turned, there = position[..., i, :], angle[..., i], opacity[..., i]
        if i < num_polygons:
            edges = turn(static.edges[..., i, :, :], turned, place)
            layers.append(Primitive(edges=edges, colour=colour, outline=outline, outline_width=_LINE_M, opacity=there))
            continue
        radius = static.radius[..., i - num_polygons]
        layers.append(
            Primitive(centre=place, radius=radius, colour=colour, outline=outline, outline_width=_LINE_M, opacity=there)
        )
        length = palette.SPOKE_SHARE * radius
        edges, faint = line_edges(length, _LINE_M, turned)
        middle = place + 0.5 * length[..., None] * _direction(turned)
        layers.append(_plain(turn(edges, jnp.zeros_like(turned), middle), outline, faint * there))
    return layers


def _thrusters(static: PixelStatic, position: Array, angle: Array) -> list[Primitive]:
    layers = []
    for k in range(static.thruster_body.shape[-1]):
        place, turned = _body(position, angle, static.thruster_body[..., k])
        edges = turn(static.thruster_edges[..., k, :, :], turned, place)
        layers.append(_plain(edges, static.thruster_colour[..., k, :], static.thruster_active[..., k]))
    return layers


def _joints(static: PixelStatic, position: Array, angle: Array) -> list[Primitive]:
    """Three things each, of which some are not there: a hinge is a disc and another in it where a motor drives it, a
    slider a rail and a block on it, a weld a cross."""
    layers = []
    for k in range(static.joint_kind.shape[-1]):
        there, kind = static.joint_active[..., k], static.joint_kind[..., k]
        is_weld, slides = kind == JointKind.FIXED, kind == JointKind.PRISMATIC
        is_hinge = ~(is_weld | slides)
        place_a, angle_a = _body(position, angle, static.joint_a[..., k])
        place_b, angle_b = _body(position, angle, static.joint_b[..., k])
        at = place_a + _rotate(static.anchor_a[..., k, :], angle_a)
        at_b = place_b + _rotate(static.anchor_b[..., k, :], angle_b)
        ink = jnp.broadcast_to(jnp.asarray(palette.INK, jnp.float32), (*there.shape, 3))
        has_motor, motor = static.motor_on[..., k], static.motor_colour[..., k, :]
        # The rail, or one arm of the cross.
        axis_angle = angle_a + static.rail[..., k, 0]
        lower, upper = static.rail[..., k, 1], static.rail[..., k, 2]
        slid = jnp.sum((at_b - at) * _direction(axis_angle), axis=-1)
        middle = 0.5 * (lower + upper) + jnp.where(static.rail_follows[..., k], slid, 0.0)
        rail, rail_faint = line_edges(upper - lower, _LINE_M, axis_angle)
        arms = [
            line_edges(2 * palette.JOINT_RADIUS_M, _WELD_M, jnp.full(there.shape, turn, jnp.float32))
            for turn in palette.WELD_ANGLES
        ]
        first = jnp.where(slides[..., None, None], rail, arms[0][0])
        middle_of_first = at + jnp.where(slides, middle, 0.0)[..., None] * _direction(axis_angle)
        faint = jnp.where(slides, rail_faint, arms[0][1]) * ~is_hinge
        upright = jnp.zeros_like(angle_a)
        layers.append(_plain(turn(first, upright, middle_of_first), ink, faint * there))
        layers.append(_plain(turn(arms[1][0], upright, at), ink, arms[1][1] * is_weld * there))
        # The hinge, with its motor; or the block of a slider.
        layers.append(
            Primitive(
                centre=at,
                radius=jnp.full(there.shape, palette.JOINT_RADIUS_M, jnp.float32),
                colour=jnp.broadcast_to(jnp.asarray(palette.HINGE, jnp.float32), ink.shape),
                outline=ink,
                outline_width=_LINE_M,
                opacity=there * is_hinge,
            )
        )
        colour = jnp.where((has_motor > 0)[..., None], motor, ink)
        share = jnp.where(slides, palette.SLIDER_SHARE, palette.MOTOR_SHARE)
        layers.append(
            Primitive(
                centre=at,
                radius=share * palette.JOINT_RADIUS_M,
                colour=colour,
                outline=colour,
                opacity=there * jnp.where(is_hinge, has_motor, slides),
            )
        )
    return layers


def _plain(edges: Array, colour: Array, opacity: Array) -> Primitive:
    return Primitive(edges=edges, colour=colour, outline=colour, opacity=opacity)


def _body(position: Array, angle: Array, number: Array) -> tuple[Array, Array]:
    """Position [..., 2] and angle [...] of shape `number` [...]."""
    index = number[..., None]
    place = jnp.take_along_axis(position, index[..., None], axis=-2)[..., 0, :]
    return place, jnp.take_along_axis(angle, index, axis=-1)[..., 0]


def _rotate(vector: Array, angle: Array) -> Array:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _direction(angle: Array) -> Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
