"""The soak: random levels of every size under random actions, and counts of what failed.

    python bench/soak.py --steps 1e10 --json soak.json        # a GPU: 131,072 worlds of each size in turn
    python bench/soak.py --steps 1e7 --worlds 512             # two CPU cores: minutes
    python bench/soak.py --replay m 3 1742 --seed 0           # one world of one episode again, alone

An episode: worlds of one size start a level each and step 512 times, new actions every `--frame-skip` steps.
Every `--episodes-per-draw` episodes each world draws a new level. What a world does depends on (seed, size, episode,
world) and on nothing else, so that one that fails can be run again by itself.
Episodes of the sizes are interleaved.

Counted: worlds that are no longer finite (with what it takes to reproduce them; any makes the exit code 1), worlds in
which a shape's centre left the box of the level, the fastest speed and spin, how often a speed limit acted, contacts
without a slot, how deep shapes overlap at the end of an episode, and energy from nothing. (Levels may start with
shapes in the walls; those are not counted where they have not been inside the box before.)

Energy from nothing, J/kg of a world's movable mass: energy after an action - the most that it was after any of the
four before - the most that motors and thrusters can have done since (`jax2d.measure.work_at_most`). (Four, because an
impact that is passed from body to body takes a few steps, in which its energy is in the overlaps.) Undoing overlaps
and pulling joints together gives a little; an explosion gives much. 1 J/kg lifts everything by 10 cm.

Speeds are those of the states after each action; the settings' limits are the largest that a state may have.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench.program import output_file, parser_of
from jax2d import Controls, Engine, preset
from jax2d.measure import energy, max_work, overlaps
from jax2d.scene import Array, Scene, State, index_worlds
from jax2d.settings import PRESETS, Settings
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.action_spaces.space import controls_of
from kinetix_dist.level.generator import GeneratorConfig, generate_level
from kinetix_dist.level.level import SIZES, WORLD_SIZE_M, Level
from kinetix_dist.level.walls import FLOOR_TOP_M

EPISODE_STEPS = 512  # physics steps, as in training
DRAW_CHUNK = 8192  # levels drawn at once: proposals of a level take some 100 kB
GAIN_EDGES = (0.01, 0.1, 1.0, 10.0, 100.0)  # J/kg
GAIN_WINDOW = 4  # actions that an energy is compared with
SETTLED_SECONDS = 1.0  # levels may start with shapes deep inside each other; by then they are apart
QUANTILES = (0.5, 0.99, 0.999, 1.0)
WORLDS_CPU, WORLDS_GPU = 256, 131072
WORLDS_MEASURED = 4096  # of an episode, for overlaps: all pairs of shapes of a world are measured


class Episode(NamedTuple):
    """Result of an episode of W worlds and T actions."""

    failed_at: Array  # [W] int32, the first action after which the world was not finite; T: none
    fastest: Array  # [T] m/s
    fastest_spin: Array  # [T] rad/s
    gains: Array  # [T, len(GAIN_EDGES)] int32, worlds that gained more than each edge from nothing
    largest_gain: Array  # [W] J/kg
    largest_gain_then: Array  # [T] J/kg
    limited: Array  # [T] int32
    overflow: Array  # [T] int32
    left_box: Array  # [W] bool, a centre that was inside the box was outside after some action
    overlap: Array  # [<= WORLDS_MEASURED] m, deepest of each world at the end
    final: Any  # packed state


class Soak:
    """Episodes of one size, compiled once for a number of worlds."""

    def __init__(self, size: str, settings: Settings, frame_skip: int, seed: int) -> None:
        self.size, self.frame_skip = size, frame_skip
        self.engine = Engine(SIZES[size], settings=settings)
        self.key = jax.random.fold_in(jax.random.key(seed), sorted(SIZES).index(size))
        self.draw = jax.jit(self._draw)
        self.play = jax.jit(self._play)

    def _draw(self, draw: Array, worlds: Array) -> Level:
        """Levels of the worlds named, [W, ...]."""
        key = jax.random.fold_in(jax.random.fold_in(self.key, 0), draw)
        config = GeneratorConfig()

        def one(world: Array) -> Level:
            return generate_level(jax.random.fold_in(key, world), self.engine.capacity, config)

        # In chunks by hand: jax.lax.map with a batch size takes no fields without elements.
        count, chunk = worlds.shape[0], min(DRAW_CHUNK, worlds.shape[0])
        chunks = jnp.pad(worlds, (0, -count % chunk), mode="edge").reshape(-1, chunk)
        levels = jax.lax.map(jax.vmap(one), chunks)
        return jax.tree.map(lambda x: x.reshape(chunks.size, *x.shape[2:])[:count], levels)

    def _play(self, episode: Array, worlds: Array, levels: Level) -> Episode:
        """One episode; worlds [W] names whose actions are drawn."""
        engine, scene = self.engine, levels.scene
        key = jax.random.fold_in(jax.random.fold_in(self.key, 1), episode)
        keys = jax.vmap(partial(jax.random.fold_in, key))(worlds)
        start = engine.initial_state(scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
        packed_scene = engine.pack_scene(scene)
        mass = jnp.maximum(_movable_mass(scene), 1e-9)
        num_actions = EPISODE_STEPS // self.frame_skip
        seconds = self.frame_skip * engine.settings.dt
        energy_of = jax.vmap(energy)
        work_bound = jax.vmap(partial(max_work, engine.settings, seconds))

        def act(carry: Any, index: Array) -> Any:
            packed, before, earlier, failed_at, largest, left_box = carry
            controls = self._controls(keys, index, levels)
            packed, touching = engine.step_packed(packed_scene, packed, controls, self.frame_skip)
            after = engine.unpack_state(packed)
            finite = _is_finite(after)
            failed_at = jnp.where(finite, failed_at, jnp.minimum(failed_at, index))
            energy_after = energy_of(scene, after)
            # [GAIN_WINDOW, W]: what each would be now, had nothing been lost since
            earlier = earlier + work_bound(scene, controls, before, after)
            gain = jnp.where(finite, (energy_after - jnp.max(earlier, axis=0)) / mass, 0.0)
            earlier = jnp.concatenate([earlier[1:], energy_after[None]])
            movable = finite[:, None] & (
                jnp.asarray(scene.shapes.inverse_mass) + jnp.asarray(scene.shapes.inverse_inertia) > 0
            )
            speed = jnp.linalg.norm(after.velocity, axis=-1)
            of_action = (
                jnp.max(jnp.where(movable, speed, 0.0)),
                jnp.max(jnp.where(movable, jnp.abs(after.angular_velocity), 0.0)),
                jnp.sum(gain[:, None] > jnp.array(GAIN_EDGES), axis=0, dtype=jnp.int32),
                jnp.max(gain),
                jnp.sum(touching.limited, dtype=jnp.int32),
                jnp.sum(touching.overflow, dtype=jnp.int32),
            )
            left_box |= finite & jnp.any(movable & _in_box(before) & ~_in_box(after), axis=-1)
            return (packed, after, earlier, failed_at, jnp.maximum(largest, gain), left_box), of_action

        none = jnp.full(worlds.shape, num_actions, jnp.int32)
        earlier = jnp.tile(energy_of(scene, start), (GAIN_WINDOW, 1))
        first = (engine.pack_state(start), start, earlier, none, jnp.zeros(worlds.shape), jnp.zeros(worlds.shape, bool))
        (packed, final, _, failed_at, largest, left_box), of_action = jax.lax.scan(act, first, jnp.arange(num_actions))
        some = index_worlds((scene, final.position, final.angle), slice(0, WORLDS_MEASURED))
        deepest = jax.lax.map(lambda one: jnp.max(overlaps(*one)), some, batch_size=256)
        fastest, fastest_spin, gains, largest_then, limited, overflow = of_action
        return Episode(
            failed_at, fastest, fastest_spin, gains, largest, largest_then, limited, overflow, left_box, deepest, packed
        )

    def _controls(self, keys: Array, index: Array, levels: Level) -> Controls:
        """Controls of a uniform multi-discrete action per world."""
        bits = jax.vmap(lambda key: jax.random.bits(jax.random.fold_in(key, index)))(keys)
        motors = [bits // 3**i % 3 for i in range(4)]
        thrusters = [bits // 81 // 2**i % 2 for i in range(2)]
        actions = jnp.stack([*motors, *thrusters], axis=-1).astype(jnp.int32)
        space = ACTION_SPACES["multi_discrete"]
        return controls_of(space, actions, levels.motor_colour, levels.motor_auto, levels.thruster_colour)[0]


def _movable_mass(scene: Scene) -> jax.Array:
    inverse = jnp.where(scene.shapes.active, scene.shapes.inverse_mass, 0.0)
    return jnp.sum(jnp.where(inverse > 0, 1.0 / jnp.where(inverse > 0, inverse, 1.0), 0.0), axis=-1)


def _in_box(state: State) -> jax.Array:
    """[W, n] bool: a shape's centre is where levels allow one."""
    x, y = state.position[..., 0], state.position[..., 1]
    return (x > 0) & (x < WORLD_SIZE_M) & (y > FLOOR_TOP_M) & (y < WORLD_SIZE_M)


def _is_finite(state: State) -> jax.Array:
    """[W] bool."""
    fields = (state.position, state.angle, state.velocity, state.angular_velocity)
    return jnp.stack([jnp.isfinite(x).reshape(x.shape[0], -1).all(-1) for x in fields]).all(0)


@dataclasses.dataclass
class Tally:
    """Results of all episodes of one size."""

    size: str
    worlds: int
    physics_steps: int = 0
    episodes: int = 0
    levels: int = 0
    seconds: float = 0.0  # stepping and measuring, without drawing levels and compiling
    draw_seconds: float = 0.0
    failures: list[dict[str, int | str]] = dataclasses.field(default_factory=list)
    fastest: float = 0.0  # m/s
    fastest_spin: float = 0.0  # rad/s
    limited: int = 0
    overflow: int = 0
    left_box: int = 0  # worlds of an episode
    gains: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(len(GAIN_EDGES), np.int64))
    largest_gain: float = 0.0
    largest_gain_in: dict[str, int] = dataclasses.field(default_factory=dict)
    largest_gain_settled: float = 0.0
    overlaps: list[np.ndarray] = dataclasses.field(default_factory=list)

    def add(self, number: int, episode: Episode, frame_skip: int, settled_after: int) -> None:
        got: Episode = jax.device_get(episode._replace(final=None))
        actions = got.fastest.shape[0]
        for world in np.flatnonzero(got.failed_at < actions):
            failure = {"size": self.size, "episode": number, "world": int(world), "action": int(got.failed_at[world])}
            self.failures.append(failure)
        self.physics_steps += self.worlds * actions * frame_skip
        self.episodes += 1
        self.fastest = max(self.fastest, float(got.fastest.max()))
        self.fastest_spin = max(self.fastest_spin, float(got.fastest_spin.max()))
        self.limited += int(got.limited.sum(dtype=np.int64))
        self.overflow += int(got.overflow.sum(dtype=np.int64))
        self.left_box += int(got.left_box.sum())
        self.gains += got.gains.sum(0, dtype=np.int64)
        settled = got.largest_gain_then[settled_after:]
        self.largest_gain_settled = max(self.largest_gain_settled, float(settled.max(initial=0.0)))
        if got.largest_gain.max() > self.largest_gain:
            self.largest_gain = float(got.largest_gain.max())
            self.largest_gain_in = {"episode": number, "world": int(got.largest_gain.argmax())}
        self.overlaps.append(got.overlap)

    def record(self, frame_skip: int) -> dict[str, Any]:
        actions = max(self.physics_steps // frame_skip, 1)
        deepest = np.concatenate(self.overlaps) if self.overlaps else np.zeros(1)
        return {
            "size": self.size,
            "worlds": self.worlds,
            "physics_steps": self.physics_steps,
            "episodes": self.episodes,
            "levels": self.levels,
            "seconds": round(self.seconds, 1),
            "draw_seconds": round(self.draw_seconds, 1),
            "not_finite": len(self.failures),
            "fastest_m_s": round(self.fastest, 2),
            "fastest_spin_rad_s": round(self.fastest_spin, 2),
            "limits_acted": self.limited,
            "limits_acted_per_step": self.limited / max(self.physics_steps, 1),
            "contact_overflow": self.overflow,
            "left_box": self.left_box,
            "share_of_actions_that_gain": {
                f"{edge} J/kg": n / actions for edge, n in zip(GAIN_EDGES, self.gains.tolist())
            },
            "largest_gain_J_kg": round(self.largest_gain, 3),
            "largest_gain_in": self.largest_gain_in,
            "largest_gain_settled_J_kg": round(self.largest_gain_settled, 3),
            "overlap_m": {str(q): round(float(np.quantile(deepest, q)), 5) for q in QUANTILES},
        }


def soak(args: argparse.Namespace) -> dict[str, Any]:
    settings = preset(args.preset)
    worlds = jnp.arange(args.worlds)
    tallies = {size: Tally(size, args.worlds) for size in args.sizes}
    soaks = {size: Soak(size, settings, args.frame_skip, args.seed) for size in args.sizes}
    levels: dict[str, Level] = {}
    settled_after = round(SETTLED_SECONDS / (args.frame_skip * settings.dt))
    started = time.perf_counter()
    number = 0
    while sum(t.physics_steps for t in tallies.values()) < args.steps:
        for size, one in soaks.items():
            tally, clock = tallies[size], time.perf_counter()
            if number % args.episodes_per_draw == 0:
                levels[size] = jax.block_until_ready(one.draw(number // args.episodes_per_draw, worlds))
                tally.levels += args.worlds
                tally.draw_seconds += time.perf_counter() - clock
            clock = time.perf_counter()
            tally.add(number, one.play(number, worlds, levels[size]), args.frame_skip, settled_after)
            if number > 0:  # the first compiles
                tally.seconds += time.perf_counter() - clock
        number += 1
        if args.seconds and time.perf_counter() - started > args.seconds:
            break
    return {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "preset": args.preset,
        "seed": args.seed,
        "frame_skip": args.frame_skip,
        "episodes_per_draw": args.episodes_per_draw,
        "physics_steps": sum(t.physics_steps for t in tallies.values()),
        "not_finite": sum(len(t.failures) for t in tallies.values()),
        "wall_seconds": round(time.perf_counter() - started, 1),
        "sizes": [t.record(args.frame_skip) for t in tallies.values()],
        "failures": [failure for t in tallies.values() for failure in t.failures],
    }


def replay(args: argparse.Namespace) -> dict[str, Any]:
    """One world of one episode, alone: to the bit what it did among the others."""
    size, episode, world = args.replay
    one = Soak(size, preset(args.preset), args.frame_skip, args.seed)
    named = jnp.array([world])
    result = one.play(episode, named, one.draw(episode // args.episodes_per_draw, named))
    tally = Tally(size, 1)
    tally.add(episode, result, args.frame_skip, settled_after=0)
    final = jax.tree.map(lambda x: np.asarray(x)[0].tolist(), one.engine.unpack_state(result.final))
    return tally.record(args.frame_skip) | {"failures": tally.failures, "final": dataclasses.asdict(final)}


def show(result: dict[str, Any]) -> None:
    rows = result["sizes"]
    lines: dict[str, list[Any]] = {
        "": [row["size"].upper() for row in rows],
        "worlds": [row["worlds"] for row in rows],
        "physics steps": [f"{row['physics_steps']:.3g}" for row in rows],
        "levels drawn": [row["levels"] for row in rows],
        "not finite": [row["not_finite"] for row in rows],
        "a centre left the box": [row["left_box"] for row in rows],
        "fastest, m/s": [row["fastest_m_s"] for row in rows],
        "fastest spin, rad/s": [row["fastest_spin_rad_s"] for row in rows],
        "speed limits acted, per step": [f"{row['limits_acted_per_step']:.2g}" for row in rows],
        "contacts without a slot": [row["contact_overflow"] for row in rows],
        "largest gain, J/kg": [row["largest_gain_J_kg"] for row in rows],
        f"after the first {SETTLED_SECONDS:g} s": [row["largest_gain_settled_J_kg"] for row in rows],
    }
    for edge in GAIN_EDGES:
        lines[f"actions that gain > {edge:g} J/kg"] = [
            f"{row['share_of_actions_that_gain'][f'{edge} J/kg']:.2g}" for row in rows
        ]
    for q in QUANTILES:
        lines[f"overlap at the end, m, {q:g}"] = [row["overlap_m"][str(q)] for row in rows]
    print(f"{result['device']}, preset {result['preset']}, seed {result['seed']}, {result['wall_seconds']} s")
    for name, cells in lines.items():
        print(f"{name:<32}" + "".join(f"{cell!s:>14}" for cell in cells))


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--steps", type=float, default=1e7, help="physics steps of all worlds together")
    parser.add_argument("--seconds", type=float, help="stop after this time, whatever the steps")
    parser.add_argument("--worlds", type=int, help="of one size; default: by device")
    parser.add_argument("--sizes", nargs="+", choices=sorted(SIZES), default=["s", "m", "l"])
    parser.add_argument("--preset", choices=sorted(PRESETS), default="standard")
    parser.add_argument("--frame-skip", type=int, default=2, help="physics steps an action is held for")
    parser.add_argument("--episodes-per-draw", type=int, default=4, help="episodes after which new levels are drawn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--replay", nargs=3, metavar=("SIZE", "EPISODE", "WORLD"), help="run one world alone")
    parser.add_argument("--json", type=output_file, help="write the result here")
    args = parser.parse_args()
    if args.worlds is None:
        args.worlds = WORLDS_GPU if jax.default_backend() == "gpu" else WORLDS_CPU
    for name in ("steps", "worlds", "frame_skip", "episodes_per_draw"):
        if not getattr(args, name) >= 1:
            parser.error(f"--{name.replace('_', '-')} is {getattr(args, name)}; give 1 or more")
    if EPISODE_STEPS % args.frame_skip:
        parser.error(f"--frame-skip is {args.frame_skip}; an episode of {EPISODE_STEPS} steps must be a multiple of it")
    if args.replay:
        size, *numbers = args.replay
        if size not in SIZES or not all(number.isdigit() for number in numbers):
            parser.error(f"--replay is {' '.join(args.replay)}; give a size (s, m or l), an episode and a world")
        args.replay = (size, *map(int, numbers))
        print(json.dumps(replay(args), indent=1))
        return 0
    result = soak(args)
    show(result)
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    for failure in result["failures"][:10]:
        again = f"python bench/soak.py --seed {args.seed} --preset {args.preset} --frame-skip {args.frame_skip}"
        again += f" --episodes-per-draw {args.episodes_per_draw}"
        print(f"not finite: {again} --replay {failure['size']} {failure['episode']} {failure['world']}")
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
