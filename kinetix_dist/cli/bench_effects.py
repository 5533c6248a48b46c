"""What each effect costs: `kinetix-dist bench engine --effects`.

    full, the levels as they are               what everything is relative to
    specialised, the levels as they are        an engine for what these levels call for
    full, the levels without friction          its code is there and finds nothing to do
    without, the levels without friction       the same worlds on an engine compiled without friction
    ...                                        for every effect
    full, bouncing everywhere                  the public levels do not bounce: every shape gets restitution 0.5
    full, an empty scene or one falling box    what an engine costs that finds next to nothing to do

The difference of the first and an effect's last is what a user saves who does without it: its own work, the work it
makes for others (without gravity few things touch) and its code. The difference of the effect's two is its code alone:
both worlds move bit for bit alike. Continuous collision is called for wherever shapes may touch, so those worlds stay
as they are and it has no row "full".

Worlds start where the full engine is at a random moment of their episodes, and every run starts there again: in
`steps` physics steps the absence of an effect changes little about where things are. Actions are drawn before. Engines
take turns run by run, in random order. A time includes the launches, one for every 2 physics steps. On a CPU it is
what this process computed, so that other jobs count little: a launch uses one core.
"""

from __future__ import annotations

import dataclasses
import random
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import Controls, Engine, JointKind, Scene, SceneBuilder, preset, stack_worlds
from jax2d.effects import EFFECTS, Effects, called_for, effects_of
from kinetix_dist.cli.bench import EFFECTS_WORLDS_CPU, EFFECTS_WORLDS_GPU, Args
from kinetix_dist.cli.bench_engine import EPISODE_STEPS, FRAME_SKIP, Record, level_files, load_levels
from kinetix_dist.cli.errors import one_line, user_errors
from kinetix_dist.level.level import SIZES, Level

# In the place of an effect's name
AS_THEY_ARE, BOUNCING, EMPTY, FALLING_BOX = "all", "bouncing everywhere", "empty scene", "one falling box"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """Worlds and the engine that steps them."""

    effect: str  # that the worlds do without, or or one of the names above
    engine: str  # "full", "without" or "specialised"
    effects: Effects  # of the engine
    scene: Any  # packed
    start: Any  # packed state


def measure(
    args: Args, report: Callable[[str], None], save: Callable[[list[Record]], None]
) -> tuple[list[Record], list[str]]:
    """All records that `args` ask for, and one line for each measurement that failed."""
    device = jax.devices()[0]
    records: list[Record] = []
    failures: list[str] = []
    with ExitStack() as stack:
        for size in args.sizes:
            files, source = stack.enter_context(level_files(args, size))
            levels = load_levels(files, size)
            for worlds in args.worlds or (EFFECTS_WORLDS_GPU if device.platform == "gpu" else EFFECTS_WORLDS_CPU):
                report(
                    f"size {size.upper()}: {len(files)} levels, {source}; {worlds} worlds, preset {args.presets[0]}, "
                    f"{device.device_kind}, jax {jax.__version__}"
                )
                try:
                    new = _measure_size(args, size, levels, worlds, device)
                except jax.errors.JaxRuntimeError as error:
                    failures.append(f"{size.upper()}, {worlds} worlds: {one_line(error)[:300]}")
                    continue
                records += new
                save(records)
                for line in table(new, called_for(levels.scene).flags):
                    report(line)
    return records, failures


def without(scene: Scene, effect: str) -> Scene:
    """The scenes of a batch without an effect. As they are for continuous collision, which cannot be edited away."""
    no, zero = np.zeros_like, np.zeros_like
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
        "joint_limits": {"joints": {"has_limits": no(scene.joints.has_limits)}},
        "motors": {"joints": {"motor_on": no(scene.joints.motor_on)}},
        "thrusters": {"thrusters": {"active": no(scene.thrusters.active)}},
        "gravity": {"gravity": zero(scene.gravity)},
    }
    for kind in JointKind:
        others = scene.joints.active & ~np.asarray(scene.joints.is_kind(kind))
        changes[f"{kind.name.lower()}_joints"] = {"joints": {"active": others}}
    return scene.replace(**changes[effect])


def table(records: list[Record], flags: Any) -> list[str]:
    """Lines to print. flags: [levels, effects] bool, which level calls for what."""
    full = next(r["us_per_world_step"] for r in records if (r["effect"], r["engine"]) == (AS_THEY_ARE, "full"))
    found = {(r["effect"], r["engine"]): r["relative_to_full"] for r in records}
    shares = np.asarray(flags).mean(axis=0)
    lines = [f"  {'full engine, levels as they are':<36} {full:7.3f} us a world and step"]
    lines += [
        f"  {what:<36} {found[key]:7.1%}"
        for what, key in {
            "engine for what these levels call for": (AS_THEY_ARE, "specialised"),
            "full engine, every shape bounces": (BOUNCING, "full"),
            "full engine, empty scene": (EMPTY, "full"),
            "full engine, one falling box": (FALLING_BOX, "full"),
        }.items()
    ]
    lines.append(
        f"  {'effect':<22} {'levels':>7} {'without it':>11} {'and engine too':>15} {'costs':>8} {'its code':>9}"
    )
    for effect, share in zip(EFFECTS, shares, strict=True):
        worlds, engine = found.get((effect, "full"), 1.0), found[effect, "without"]
        lines.append(
            f"  {effect:<22} {share:7.0%} {worlds:11.1%} {engine:15.1%} {1 - engine:8.1%} {worlds - engine:9.1%}"
        )
    return lines


def _measure_size(args: Args, size: str, levels: Level, worlds: int, device: Any) -> list[Record]:
    capacity = SIZES[size]
    with user_errors(ValueError):
        settings = preset(args.presets[0])
    full = Engine(capacity, settings=settings)
    controls = _random_controls(args, full, worlds)
    cases = _cases(full, levels, worlds, _random_controls(args, full, worlds, EPISODE_STEPS), args.seed)
    # One program an engine: cases of the same engine differ in what they are given.
    engines = {effects: Engine(capacity, settings=settings, effects=effects) for effects in {c.effects for c in cases}}
    programs = {effects: _program(engine) for effects, engine in engines.items()}
    clock = time.perf_counter if device.platform == "gpu" else time.process_time
    seconds: list[list[float]] = [[] for _ in cases]
    turns = random.Random(args.seed)
    for repeat in range(1 + args.repeats):
        # In another order each turn: caches are warm or cold by what ran before.
        for case, times in turns.sample(list(zip(cases, seconds, strict=True)), len(cases)):
            started = clock()
            jax.block_until_ready(programs[case.effects](case.scene, case.start, controls))
            if repeat:  # the first run compiles
                times.append(clock() - started)
    reference = statistics.median(seconds[0])
    return [
        {
            "size": size,
            "effect": case.effect,
            "engine": case.engine,
            "worlds": worlds,
            "device": device.device_kind,
            "us_per_world_step": round(1e6 * statistics.median(times) / (worlds * args.steps), 5),
            "relative_to_full": round(statistics.median(times) / reference, 4),
        }
        for case, times in zip(cases, seconds, strict=True)
    ]


def _cases(full: Engine, levels: Level, worlds: int, controls: Controls, seed: int) -> list[Case]:
    """The first is the full engine on the levels as they are."""
    order = jnp.arange(worlds) % len(levels.position)
    spread = partial(jax.tree.map, lambda x: jnp.take(x, order, axis=-1))  # packed arrays have the world axis last
    state = full.initial_state(levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
    scene = spread(full.pack_scene(levels.scene))
    start = _at_random_moments(full, scene, spread(full.pack_state(state)), controls, seed)
    everything = full.effects

    def case(effect: str, engine: str, effects: Effects, scene: Any = scene, start: Any = start) -> Case:
        return Case(effect=effect, engine=engine, effects=effects, scene=scene, start=start)

    cases = [
        case(AS_THEY_ARE, "full", everything),
        case(AS_THEY_ARE, "specialised", effects_of(levels.scene)),
    ]
    for effect in EFFECTS:
        edited = spread(full.pack_scene(without(levels.scene, effect)))
        if effect != "continuous_collision":
            cases.append(case(effect, "full", everything, edited))
        cases.append(case(effect, "without", everything.without(effect), edited))
    bouncing = levels.scene.replace(shapes={"restitution": np.full_like(levels.scene.shapes.restitution, 0.5)})
    cases.append(case(BOUNCING, "full", everything, spread(full.pack_scene(bouncing))))
    for name, num_boxes in ((EMPTY, 0), (FALLING_BOX, 1)):
        builder = SceneBuilder(full.capacity)
        for _ in range(num_boxes):
            builder.add_box(width=0.5, height=0.5, position=(2.5, 2.5))
        world = builder.build()
        scene, state = stack_worlds([(world.scene, full.initial_state(*world))])
        packed = jax.tree.map(lambda x: jnp.repeat(x, worlds, -1), (full.pack_scene(scene), full.pack_state(state)))
        cases.append(case(name, "full", everything, *packed))
    return cases


def _at_random_moments(engine: Engine, scene: Any, start: Any, controls: Controls, seed: int) -> Any:
    """The packed state of each world at a moment of its own, as the full engine gets there from the start."""
    num_calls = controls.motor.shape[0]
    moments = jax.random.randint(jax.random.key(seed), scene.missing.shape, 0, num_calls)

    @jax.jit
    def play(scene: Any, start: Any, controls: Controls) -> Any:
        def advance(carry: tuple[Any, Any], now: tuple[Any, Controls]) -> tuple[tuple[Any, Any], None]:
            state, kept = carry
            kept = jax.tree.map(lambda a, b: jnp.where(moments == now[0], a, b), state, kept)
            return (engine.step_packed(scene, state, now[1], num_steps=FRAME_SKIP)[0], kept), None

        return jax.lax.scan(advance, (start, start), (jnp.arange(num_calls), controls))[0][1]

    return play(scene, start, controls)


def _program(engine: Engine) -> Callable[[Any, Any, Controls], Any]:
    @jax.jit
    def run_steps(scene: Any, state: Any, controls: Controls) -> Any:
        def advance(state: Any, now: Controls) -> tuple[Any, None]:
            return engine.step_packed(scene, state, now, num_steps=FRAME_SKIP)[0], None

        return jax.lax.scan(advance, state, controls)[0]

    return run_steps


def _random_controls(args: Args, engine: Engine, worlds: int, num_steps: int | None = None) -> Controls:
    """[calls, W, ...] on both fields, each for FRAME_SKIP physics steps."""
    calls, c = (args.steps if num_steps is None else num_steps) // FRAME_SKIP, engine.capacity
    motor_key, thruster_key = jax.random.split(jax.random.key(args.seed))
    return Controls(
        motor=jax.random.randint(motor_key, (calls, worlds, c.joints), -1, 2).astype(jnp.float32),
        thruster=jax.random.randint(thruster_key, (calls, worlds, c.thrusters), 0, 2).astype(jnp.float32),
    )
