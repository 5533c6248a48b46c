"""Worlds that the cost of effects is measured on: levels as they are, and edited to do without an effect.

    full, the levels as they are               what everything is relative to
    specialised, the levels as they are        an engine for what these levels call for
    full, the levels without friction          its code runs and finds nothing to do
    without, the levels without friction       the same worlds on an engine compiled without friction
    ...                                        for every effect
    full, bouncing everywhere                  the public levels do not bounce: every shape gets restitution 0.5
    full, an empty scene or one falling box    what an engine costs that finds next to nothing to do
    larger, the levels as they are             an engine with slots for effects that no level has: belts, springs, ...
    larger, the levels with belts              every shape has one; likewise damping, rolling resistance, springs

Continuous collision is called for wherever shapes may touch, so those worlds stay as they are and it has no row "full".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import Capacity, Controls, Engine, JointKind, Scene, SceneBuilder, stack_worlds
from jax2d.effects import EFFECTS, Effects, effects_of
from jax2d.fields import broadcast, empty
from kinetix_dist import prng
from kinetix_dist.benchmarks.engine_worlds import FRAME_SKIP, take_worlds
from kinetix_dist.level.level import NUM_WALLS, Level

NUM_SPRINGS = 2
ADDED = ("springs", "surface_speed", "damping", "rolling_resistance")  # which no level has
# Instead of the name of an effect
AS_THEY_ARE, BOUNCING, EMPTY, FALLING_BOX = "all", "bouncing everywhere", "empty scene", "one falling box"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """Worlds and the engine that steps them."""

    effect: str  # that the worlds do without, or one of the names above
    engine: str  # "full", "without", "specialised" or "larger"
    capacity: Capacity  # of the engine
    effects: Effects  # of the engine
    scene: Any  # packed
    start: Any  # packed state


def without(scene: Scene, effect: str) -> Scene:
    """The scenes of a batch without an effect. As they are for continuous collision, which cannot be edited away."""
    zero = np.zeros_like
    polygons = np.shape(scene.shapes.vertices)[-3]
    is_circle = np.arange(np.shape(scene.shapes.radius)[-1] + polygons) >= polygons
    num_circles = is_circle[:, None].astype(int) + is_circle[None, :]
    can_touch = np.asarray(scene.shapes.can_touch)
    changes: dict[str, dict[str, Any]] = {
        "polygon_pairs": {"shapes": {"can_touch": can_touch & (num_circles != 0)}},
        "polygon_circle_pairs": {"shapes": {"can_touch": can_touch & (num_circles != 1)}},
        "circle_pairs": {"shapes": {"can_touch": can_touch & (num_circles != 2)}},
        "friction": {"shapes": {"friction": zero(scene.shapes.friction)}},
        "restitution": {"shapes": {"restitution": zero(scene.shapes.restitution)}},
        "continuous_collision": {},
        "joint_limits": {"joints": {"has_limits": zero(scene.joints.has_limits)}},
        "motors": {"joints": {"motor_on": zero(scene.joints.motor_on)}},
        "brakes_and_servos": {"joints": {"drive": zero(scene.joints.drive)}},
        "springs": {"springs": {"active": zero(scene.springs.active)}},
        "thrusters": {"thrusters": {"active": zero(scene.thrusters.active)}},
        "gravity": {"gravity": zero(scene.gravity)},
        "kinematic_bodies": {"shapes": {"kinematic": zero(scene.shapes.kinematic)}},
    }
    for kind in JointKind:
        others = scene.joints.active & ~np.asarray(scene.joints.is_kind(kind))
        changes[f"{kind.name.lower()}_joints"] = {"joints": {"active": others}}
    return scene.replace(**changes[effect])


def in_capacity(records: Any, capacity: Capacity, batch: tuple[int, ...]) -> Any:
    """A batch of scenes or states in arrays of a capacity that differs in what they have nothing of."""
    wider = broadcast(empty(type(records), capacity.sizes), batch)
    return jax.tree.map(lambda new, old: old if np.shape(old) == np.shape(new) else jnp.asarray(new), wider, records)


def with_effect(scene: Scene, effect: str) -> Scene:
    """The scenes of a batch, whose capacity has it, with an effect wherever it can be."""
    each = np.zeros_like(scene.shapes.surface_speed)
    if effect == "springs":
        active = np.asarray(scene.shapes.active)
        # From the floor, slot 0, to what comes first after the walls.
        ends = np.argsort(~active, axis=-1, kind="stable")[..., NUM_WALLS : NUM_WALLS + NUM_SPRINGS]
        hangs = np.take_along_axis(active, ends, axis=-1)
        values = {"rest_length": 3.0, "stiffness": 2.0, "damping": 0.1}
        springs = {name: np.full(ends.shape, value, np.float32) for name, value in values.items()}
        return scene.replace(springs={"active": hangs, "b": ends.astype(np.int32), **springs})
    changes = {
        "surface_speed": {"surface_speed": each + 0.5},
        "damping": {"linear_damping": each + 0.1, "angular_damping": each + 0.1},
        "rolling_resistance": {"rolling_resistance": each + 0.02},
    }
    return scene.replace(shapes=changes[effect])


def cases_of(full: Engine, levels: Level, played: jax.Array, controls: Controls, seed: int) -> list[Case]:
    """All cases; the first is the full engine on the levels as they are.

    played [W]: number of the level of each world. controls: [calls, W, ...], random actions of an episode. Every world
    starts where they lead to at a random moment.
    """
    worlds = controls.motor.shape[1]
    spread = partial(take_worlds, order=played)
    state = full.initial_state(levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
    as_they_are = spread(full.pack_scene(levels.scene))
    start = _at_random_moments(full, as_they_are, spread(full.pack_state(state)), controls, seed)
    everything = full.effects

    def case(effect: str, engine: str, effects: Effects, scene: Any = as_they_are, start: Any = start) -> Case:
        return Case(effect=effect, engine=engine, capacity=full.capacity, effects=effects, scene=scene, start=start)

    cases = [
        case(AS_THEY_ARE, "full", everything),
        case(AS_THEY_ARE, "specialised", effects_of(levels.scene)),
    ]
    for effect in (name for name in EFFECTS if getattr(everything, name)):
        edited = spread(full.pack_scene(without(levels.scene, effect)))
        if effect != "continuous_collision":
            cases.append(case(effect, "full", everything, edited))
        cases.append(case(effect, "without", everything.without(effect), edited))
    bouncing = levels.scene.replace(shapes={"restitution": np.full_like(levels.scene.shapes.restitution, 0.5)})
    cases.append(case(BOUNCING, "full", everything, spread(full.pack_scene(bouncing))))
    for name, num_boxes in ((EMPTY, 0), (FALLING_BOX, 1)):
        cases.append(case(name, "full", everything, *_falling_boxes(full, num_boxes, worlds)))
    return cases + _cases_of_larger_engine(full, levels.scene, start, spread)


def _cases_of_larger_engine(full: Engine, scene: Scene, start: Any, spread: Callable[[Any], Any]) -> list[Case]:
    """Cases of effects that only a larger capacity has; the worlds start where the full engine's do."""
    capacity = dataclasses.replace(full.capacity, extended_shapes=True, springs=NUM_SPRINGS)
    engine = Engine(capacity, settings=full.settings)
    scene = in_capacity(scene, capacity, np.shape(scene.gravity)[:-1])
    scenes = {AS_THEY_ARE: scene} | {effect: with_effect(scene, effect) for effect in ADDED}
    state = full.unpack_state(start)
    starts = engine.pack_state(in_capacity(state, capacity, state.position.shape[:-2]))
    return [
        Case(
            effect=name,
            engine="larger",
            capacity=capacity,
            effects=engine.effects,
            scene=spread(engine.pack_scene(one)),
            start=starts,
        )
        for name, one in scenes.items()
    ]


def _falling_boxes(engine: Engine, num_boxes: int, worlds: int) -> tuple[Any, Any]:
    builder = SceneBuilder(engine.capacity)
    for _ in range(num_boxes):
        builder.add_box(width=0.5, height=0.5, position=(2.5, 2.5))
    world = builder.build()
    scene, state = stack_worlds([(world.scene, engine.initial_state(*world))])
    return take_worlds((engine.pack_scene(scene), engine.pack_state(state)), jnp.zeros(worlds, jnp.int32))


def _at_random_moments(engine: Engine, scene: Any, start: Any, controls: Controls, seed: int) -> Any:
    """The packed state of each world at a moment of its own, as the full engine gets there from the start."""
    num_calls = controls.motor.shape[0]
    moments = prng.randint(prng.key(seed), scene.missing.shape, 0, num_calls)

    @jax.jit
    def play(scene: Any, start: Any, controls: Controls) -> Any:
        def advance(carry: tuple[Any, Any], now: tuple[Any, Controls]) -> tuple[tuple[Any, Any], None]:
            state, chosen = carry
            chosen = jax.tree.map(lambda a, b: jnp.where(moments == now[0], a, b), state, chosen)
            return (engine.step_packed(scene, state, now[1], num_steps=FRAME_SKIP)[0], chosen), None

        return jax.lax.scan(advance, (start, start), (jnp.arange(num_calls), controls))[0][1]

    return play(scene, start, controls)
