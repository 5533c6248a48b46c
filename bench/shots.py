"""Shots: discs and boxes of three sizes at walls that are fixed, moved, swung or turned; what passes is counted.

    python bench/shots.py --shots 1e6 --json shots.json      # a GPU: 1e6 of each size, judged on all cores
    python bench/shots.py --shots 3000                       # two CPU cores: a minute

Targets: the last 60 cm of a fixed wall; a gap half as wide as what is shot at it; a free wall of ten times the
density, which moves and turns; a wall that hangs on a pivot; a bar of 2 m that turns at up to 45 rad/s. Speeds are
2 to 100 m/s, spread evenly over their logarithm.

A shot has passed where a step that left its velocity as it was led it into a target, deeper than 0.3 of the thinner
of the two, or where its centre is on the other side of a target after a step: judged in float64 along the straight
path of the step, by geometry that shares no code with the engine (`tests/engine/oracle.py`). Being inside while a
contact pushes is not passing.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # run as a script where the project is not installed

from bench.program import output_file, parser_of
from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset, record
from jax2d.fields import broadcast
from jax2d.settings import PRESETS
from tests.engine.oracle import disc_overlap, polygons_overlap, rotation

CAPACITY = Capacity(polygons=3, circles=2, joints=1, thrusters=0)
TARGETS = ("end of a wall", "gap", "free wall", "hinged wall", "turning bar")
SIZES_M = (0.03, 0.1, 0.3)  # radius of a disc; a box is twice as long as that and as high
SPEEDS_M_S = (2.0, 100.0)
BIN_EDGES_M_S = (2.0, 5.0, 10.0, 20.0, 40.0, 70.0, 100.0)
WALL_M, BAR_M = 4.0, 2.0  # lengths
NUM_STEPS = 30
BATCH = 8192  # worlds stepped, and judged by one process, at once
COARSE = np.linspace(0, 1, 7)  # moments of a step
CLOSER = np.linspace(0, 1, 9)[1:-1]  # of a stretch between two of these
UNCHANGED = 1e-3  # m/s and rad/s: nothing was touched


@dataclasses.dataclass(frozen=True)
class Shots:
    """N flights, float64; `shot` is one body, `walls` are what it is shot at."""

    speed: np.ndarray  # [N] m/s
    position: np.ndarray  # [T, N, n, 2] m
    angle: np.ndarray  # [T, N, n] rad
    velocity: np.ndarray  # [T, N, n, 2] m/s
    spin: np.ndarray  # [T, N, n] rad/s
    corners: list[np.ndarray]  # of each polygon, [4, 2] m in its own frame
    shot: int
    walls: tuple[int, ...]
    radius: float | None  # m, of a disc
    limit: float  # m


def world_of(target: str, size: float, is_box: bool) -> tuple[BuiltWorld, int, tuple[int, ...]]:
    """A world whose walls stand upright, the shot, and the walls."""
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    box: dict[str, Any] = {"width": thickness_of(size), "height": BAR_M if target == "turning bar" else WALL_M}
    if target == "gap":
        half = 0.25 * (size if is_box else 2 * size)
        walls: tuple[int, ...] = tuple(
            b.add_box(**box, position=(0, side * (WALL_M / 2 + half)), fixed=True) for side in (-1, 1)
        )
    elif target == "end of a wall":
        walls = (b.add_box(**box, position=(0, -WALL_M / 2), fixed=True),)
    elif target == "hinged wall":
        walls = (b.add_box(**box, position=(0, -WALL_M / 2), density=10.0),)
    else:
        walls = (b.add_box(**box, density=100.0 if target == "turning bar" else 10.0),)
    start = {"position": (-3.0, 0.0)}
    shot = b.add_box(width=2 * size, height=size, **start) if is_box else b.add_circle(radius=size, **start)
    if target in ("hinged wall", "turning bar"):
        b.add_revolute_joint(b.add_circle(radius=0.02, fixed=True), walls[0], at=(0, 0))
    return b.build(), shot, walls


def thickness_of(size: float) -> float:
    return 0.04 if size < 0.1 else 0.1


def aim(target: str, size: float, number: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """[number] each: speed, angle of flight, the point that is aimed at, the distance to it, and how walls move."""
    slowest, fastest = np.log(SPEEDS_M_S)
    speed = np.exp(rng.uniform(slowest, fastest, number))
    side = rng.choice([-1.0, 1.0], number)
    tilt = np.radians(rng.uniform(15, 75, number)) * side
    y = -rng.uniform(0, 0.6, number)
    if target == "gap":
        tilt = np.radians(rng.uniform(-60, 60, number))
        y = rng.uniform(-2, 2, number) * size
    elif target == "turning bar":
        tilt = np.radians(rng.uniform(-60, 60, number))
        y = rng.uniform(-0.95, 0.95, number) * BAR_M / 2
    elif target == "free wall":
        y = rng.uniform(-1.05, 1.05, number) * WALL_M / 2
    elif target == "hinged wall":
        y = -WALL_M * rng.uniform(0.02, 1.02, number)
    still = np.zeros(number)
    return {
        "speed": speed,
        "heading": np.stack([np.cos(tilt), np.sin(tilt)], -1),
        "at": np.stack([still, y], -1),
        "distance": 2.5 * size + thickness_of(size) + rng.uniform(0, 2, number) * np.maximum(speed, 10) / 60,
        "wall_speed": rng.uniform(-20, 20, number) if target == "free wall" else still,
        "wall_spin": rng.uniform(5, 45, number) * side
        if target == "turning bar"
        else rng.uniform(-2, 2, number)
        if target == "free wall"
        else still,
        "wall_angle": rng.uniform(0, np.pi, number) if target == "turning bar" else still,
        "spin": rng.uniform(-10, 10, number),
        "angle": rng.uniform(0, np.pi, number),
    }


def fly(engine: Engine, target: str, size: float, is_box: bool, number: int, seed: int) -> Shots:
    """`number` shots of a kind, stepped."""
    world, shot, walls = world_of(target, size, is_box)
    kind = (TARGETS.index(target), SIZES_M.index(size), int(is_box))
    aimed = aim(target, size, number, np.random.default_rng((seed, *kind)))
    scene, start = broadcast(world.scene, (number,)), {}
    n = CAPACITY.polygons + CAPACITY.circles
    for name in ("position", "velocity"):
        start[name] = np.tile(np.asarray(getattr(world, name), np.float64), (number, 1, 1))
    for name in ("angle", "angular_velocity"):
        start[name] = np.zeros((number, n))
    # From the right the wall comes to meet it, or flees: never faster than the shot.
    along = aimed["speed"] * aimed["heading"][:, 0]
    wall_speed = np.clip(aimed["wall_speed"], -20, 0.7 * along)
    start["velocity"][:, walls[0], 0] = wall_speed
    start["angular_velocity"][:, walls[0]] = aimed["wall_spin"]
    start["angle"][:, walls[0]] = aimed["wall_angle"]
    relative = aimed["speed"][:, None] * aimed["heading"] - np.stack([wall_speed, 0 * wall_speed], -1)
    back = aimed["distance"] + (BAR_M / 2 if target == "turning bar" else 0.0)
    start["position"][:, shot] = aimed["at"] - back[:, None] * relative / np.linalg.norm(relative, axis=-1)[:, None]
    start["velocity"][:, shot] = aimed["speed"][:, None] * aimed["heading"]
    if is_box:
        start["angle"][:, shot], start["angular_velocity"][:, shot] = aimed["angle"], aimed["spin"]
    t, _ = record(engine, scene, engine.initial_state(scene, **start), num_samples=NUM_STEPS)
    corners = [np.asarray(v, np.float64)[:4] for v in np.asarray(world.scene.shapes.vertices)]
    return Shots(
        aimed["speed"],
        t.position,
        t.angle,
        t.velocity,
        t.angular_velocity,
        corners,
        shot,
        walls,
        None if is_box else size,
        0.3 * min(size if is_box else 2 * size, thickness_of(size)),
    )


def judge(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """[N] bool each: which count, since they start free of their targets, and which of these passed one."""
    counts, found = np.ones(len(shots.speed), bool), np.zeros(len(shots.speed), bool)
    for wall in shots.walls:
        pair = [shots.shot, wall]
        counts &= depth(shots, wall, shots.position[0][:, pair], shots.angle[0][:, pair]) < 0
        found |= passed_one(shots, wall)
    return counts, counts & found


def passed_one(shots: Shots, wall: int) -> np.ndarray:
    """[N] bool: of one wall."""
    pair = [shots.shot, wall]
    position, angle = shots.position[:, :, pair], shots.angle[:, :, pair]
    return passed_untouched(shots, wall, position, angle) | changed_sides(shots, wall, position, angle)


def passed_untouched(shots: Shots, wall: int, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[N] bool: whether a step that left the shot's velocity as it was led it into the wall, deeper than the limit."""
    body = shots.shot
    change = np.abs(np.diff(shots.velocity[:, :, body], axis=0)).max(-1)
    change += np.abs(np.diff(shots.spin[:, :, body], axis=0))
    travel = np.linalg.norm(np.diff(position, axis=0), axis=-1).sum(-1)
    reach = np.linalg.norm(shots.corners[wall], axis=-1).max()
    swept = travel + np.abs(np.diff(angle, axis=0))[..., 1] * reach + 0.02
    near = swept > apart(shots, wall, position[:-1], angle[:-1])
    before = np.full(near.shape, -np.inf)
    before[near] = depth(shots, wall, position[:-1][near], angle[:-1][near])
    steps, worlds = np.nonzero((change <= UNCHANGED) & (before >= shots.limit - swept) & (before <= shots.limit))
    found = np.zeros(position.shape[1], bool)

    def depths(k: np.ndarray, w: np.ndarray, moments: np.ndarray) -> np.ndarray:
        """[..., n] m, at moments [..., n] of steps k [n] of worlds w [n]."""
        at = position[k, w] + moments[..., None, None] * (position[k + 1, w] - position[k, w])
        return depth(shots, wall, at, angle[k, w] + moments[..., None] * (angle[k + 1, w] - angle[k, w]))

    for part in np.array_split(np.arange(len(steps)), max(len(steps) // 4096, 1)):
        k, w = steps[part], worlds[part]
        coarse = depths(k, w, np.broadcast_to(COARSE[:, None], (len(COARSE), len(part))))
        found[w[coarse.max(0) > shots.limit]] = True
        # Depth changes by at most `swept` a step, so most stretches between two moments need no closer look.
        may = (coarse[1:] + coarse[:-1] + swept[k, w] / (len(COARSE) - 1)) / 2 > shots.limit
        stretch, which = np.nonzero(may)
        closer = COARSE[stretch] + CLOSER[:, None] * COARSE[1]
        found[w[which][(depths(k[which], w[which], closer) > shots.limit).any(0)]] = True
    return found


def apart(shots: Shots, wall: int, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[...] m: at least so far is the shot from the wall, by the circle around it; negative where that touches it."""
    away = np.abs(in_frame_of_wall(position, angle)) - np.abs(shots.corners[wall]).max(0)
    return away.max(-1) - (shots.radius or np.linalg.norm(shots.corners[shots.shot], axis=-1).max())


def in_frame_of_wall(position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[..., 2] m: the shot's centre, of [..., 2, 2] m and [..., 2] rad of the shot and the wall."""
    away = position[..., 0, :] - position[..., 1, :]
    return (np.swapaxes(rotation(angle[..., 1]), -1, -2) @ away[..., None])[..., 0]


def changed_sides(shots: Shots, wall: int, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[N] bool: whether a centre was on one side of a wall after a step and on the other after the next, not at its
    end."""
    local = in_frame_of_wall(position, angle)
    half_length = shots.corners[wall][:, 1].max()
    is_alongside = np.abs(local[..., 1]) < half_length - (shots.radius or 0.0)
    return (is_alongside[1:] & is_alongside[:-1] & (local[1:, :, 0] * local[:-1, :, 0] < 0)).any(0)


def depth(shots: Shots, wall: int, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[...] m, of [..., 2, 2] m and [..., 2] rad of the shot and the wall."""

    def placed(polygon: int, which: int) -> np.ndarray:
        turned = shots.corners[polygon] @ np.swapaxes(rotation(angle[..., which]), -1, -2)
        return turned + position[..., which, None, :]

    if shots.radius is not None:
        return disc_overlap(placed(wall, 1), position[..., 0, :], shots.radius)
    return polygons_overlap(placed(wall, 1), placed(shots.shot, 0))


def by_speed(speed: np.ndarray, chosen: np.ndarray) -> list[int]:
    return np.histogram(speed[chosen], BIN_EDGES_M_S)[0].tolist()


def run(args: argparse.Namespace) -> dict[str, Any]:
    engine = Engine(CAPACITY, settings=preset(args.preset))
    kinds = [(target, size, is_box) for size in SIZES_M for is_box in (False, True) for target in TARGETS]
    number = max(round(args.shots / (len(kinds) / len(SIZES_M))), 1)
    started, judging = time.perf_counter(), []
    workers = ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))
    totals = {kind: [np.zeros(len(BIN_EDGES_M_S) - 1, int) for _ in range(2)] for kind in kinds}

    def collect(most: int) -> None:
        while len(judging) > most:
            kind, speed, work = judging.pop(0)
            for total, chosen in zip(totals[kind], work.result(), strict=True):
                total += by_speed(speed, chosen)

    with workers:
        for kind in kinds:
            for first in range(0, number, BATCH):
                shots = fly(engine, *kind, min(BATCH, number - first), args.seed + first)
                judging.append((kind, shots.speed, workers.submit(judge, shots)))
                collect(2 * (os.cpu_count() or 1))
        collect(0)
    rows: list[dict[str, Any]] = [
        {"target": kind[0], "size_m": kind[1], "shape": "box" if kind[2] else "disc"}
        | {"shots": shots.tolist(), "passed": through.tolist()}
        for kind, (shots, through) in totals.items()
    ]
    return {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "preset": args.preset,
        "seed": args.seed,
        "speed_edges_m_s": BIN_EDGES_M_S,
        "wall_seconds": round(time.perf_counter() - started, 1),
        "shots": int(sum(sum(row["shots"]) for row in rows)),
        "passed": int(sum(sum(row["passed"]) for row in rows)),
        "kinds": rows,
    }


def show(result: dict[str, Any]) -> None:
    edges = result["speed_edges_m_s"]
    print(
        f"{result['device']}, preset {result['preset']}, seed {result['seed']}, {result['wall_seconds']} s: passed, of"
    )
    names = [f"{a:g}-{b:g} m/s" for a, b in itertools.pairwise(edges)]
    print(f"{'':<34}" + "".join(f"{name:>14}" for name in names))
    for row in result["kinds"]:
        cells = [f"{n} / {of}" for n, of in zip(row["passed"], row["shots"])]
        name = f"{row['shape']} {100 * row['size_m']:g} cm, {row['target']}"
        print(f"{name:<34}" + "".join(f"{cell:>14}" for cell in cells))
    print(f"{result['passed']} of {result['shots']:.3g} passed")


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--shots", type=float, default=1e4, help="of each of the three sizes")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="standard")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=output_file, help="write the result here")
    args = parser.parse_args()
    if not args.shots >= 1:
        parser.error(f"--shots is {args.shots:g}; give 1 or more")
    result = run(args)
    show(result)
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
