"""The public levels, level by level: ours beside the public Kinetix package, by the same actions.

    bash bench/peers/setup_kinetix.sh
    python -m bench.public_package --levels FOLDER --json runs/public_package.json

Each level is played once by nobody and once by each of the random policies, which draw every action of every step
uniformly; both sides are given the same actions. The package plays in its own environment and its outcomes are kept
in runs/public_package/; ours plays in several ways, which say what a difference comes from:

    standard, paper       the level as it is imported, presets of that name
    +masses               with masses, inertias and centres of mass of the file instead of those of its shapes
    paper,motor_decay=1   the same with other numbers in the settings
    standard,dt=0.0041666667    finer steps; actions are held for as long as before

A level differs where the exact paired test (McNemar) on the two outcomes of each policy gives p < 0.001.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import importlib.metadata
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bench.peer_process import PUBLIC_PACKAGE_PLAY, PeerMissing
from bench.program import exit_code, output_file, parser_of
from jax2d import Engine, Settings, preset
from jax2d.scene import stack_worlds
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import UserError
from kinetix_dist.evaluation.intervals import Z_95
from kinetix_dist.evaluation.recordings import record_actions
from kinetix_dist.evaluation.search.worlds import Worlds
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.kinetix_format import load_kinetix
from kinetix_dist.level.level import SIZES, Level

NUM_STEPS = 256  # of an episode
ACTION_S = 2 / 60  # an action is held for, as in the package
OUTCOMES = ("none", "solved", "red", "not finite")
DIFFERS_BELOW = 1e-3  # p: of 74 levels that do not differ, fewer than one in thirteen such studies names one
APART_M = 0.1  # what counts as another way of moving


@dataclasses.dataclass(frozen=True, kw_only=True)
class Way:
    """How our side plays."""

    name: str
    settings: Settings
    has_masses_of_file: bool = False

    @property
    def frame_skip(self) -> int:
        """Physics steps that an action is held for."""
        return round(ACTION_S / self.settings.dt)


WAYS = ("standard", "standard+masses", "paper", "paper+masses")


def way_of(text: str) -> Way:
    """PRESET, PRESET+masses, either with ",FIELD=VALUE" of its settings after it. Raises UserError."""
    head, *changes = text.split(",")
    name, plus, extra = head.partition("+")
    if plus and extra != "masses":
        raise UserError(f"--ways has {text!r}; after a preset there may be +masses and ,FIELD=VALUE")
    try:
        numbers = {field: float(value) for field, _, value in (change.partition("=") for change in changes)}
        settings = preset(name).replace(**numbers)
    except (ValueError, TypeError) as error:
        raise UserError(f"--ways has {text!r}: {error}") from None
    way = Way(name=text, settings=settings, has_masses_of_file=bool(plus))
    if abs(way.frame_skip * settings.dt - ACTION_S) > 1e-6:
        raise UserError(f"--ways has {text!r}: an action is held for {ACTION_S:.6f} s, which is no multiple of that dt")
    return way


@dataclasses.dataclass(frozen=True, kw_only=True)
class Played:
    """Outcomes (of OUTCOMES) of some levels: [levels, 1 + policies], nobody first; and what moved when nobody acted."""

    outcome: np.ndarray
    position: list[np.ndarray]  # of each level [T, active shapes, 2] m after each step, T up to its end at the latest


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, prog="python -m bench.public_package")
    parser.add_argument(
        "--levels", default=os.environ.get("KINETIX_LEVELS"), help="public levels (s/, m/, l/); or $KINETIX_LEVELS"
    )
    parser.add_argument("--sizes", nargs="+", choices=tuple(SIZES), default=list(SIZES))
    parser.add_argument("--policies", type=int, default=100, help="random ones")
    parser.add_argument("--seed", type=int, default=0, help="of their actions")
    parser.add_argument("--ways", nargs="+", default=WAYS, help="PRESET[+masses][,FIELD=VALUE...] of settings")
    parser.add_argument(
        "--played", type=Path, default=Path("runs/public_package"), help="the package's; made if absent"
    )
    parser.add_argument("--json", type=output_file)
    parser.add_argument("--csv", type=output_file)
    args = parser.parse_args(arguments)
    return exit_code(parser, lambda: run(args))


def run(args: argparse.Namespace) -> int:
    if not args.levels:
        raise UserError("where are the public levels? name their folder with --levels or $KINETIX_LEVELS")
    if args.policies < 1:
        raise UserError(f"--policies is {args.policies}; give 1 or more")
    ways = [way_of(text) for text in args.ways]
    files = {size: sorted(Path(args.levels, size).glob("*.json")) for size in args.sizes}
    if missing := [size for size in args.sizes if not files[size]]:
        raise UserError(f"no public levels in {Path(args.levels, missing[0])}; name their folder with --levels")
    actions = random_actions(args.policies, args.seed)
    rows, seconds, described = [], {}, {}
    for size in args.sizes:
        recorded = args.played / f"{size}-seed{args.seed}-{args.policies}.npz"
        if not recorded.is_file():
            play_published(files[size], actions, recorded)
        theirs, described = read_published(recorded, files[size], args.policies)
        ours = {}
        for way in ways:
            started = time.perf_counter()
            ours[way.name] = play_ours(files[size], size, actions, way)
            seconds[f"{size}, {way.name}"] = round(time.perf_counter() - started, 1)
        rows += [row_of(size, file, level, theirs, ours) for level, file in enumerate(files[size])]
    show(rows, [way.name for way in ways])
    if args.json:
        versions = {name: importlib.metadata.version(name) for name in ("jax", "numpy", "warp-lang")}
        asked = {"policies": args.policies, "seed": args.seed, "steps": NUM_STEPS}
        document = asked | {"package": described, "versions": versions, "seconds": seconds, "levels": rows}
        args.json.write_text(json.dumps(document, indent=1) + "\n")
    if args.csv:
        write_csv(args.csv, rows)
    return 0


def random_actions(num_policies: int, seed: int) -> np.ndarray:
    """[T, 1 + policies, 6] int32 multi-discrete actions; those of the first world are all "off"."""
    choices = np.array([3, 3, 3, 3, 2, 2])
    actions = np.random.default_rng(seed).integers(0, choices, (NUM_STEPS, 1 + num_policies, 6), dtype=np.int32)
    actions[:, 0] = 0
    return actions


def play_published(files: list[Path], actions: np.ndarray, to: Path) -> None:
    print(f"the public package plays {len(files)} levels of {files[0].parent}", flush=True)
    to.parent.mkdir(parents=True, exist_ok=True)
    array = to.with_suffix(".actions.npy")
    np.save(array, actions)
    try:
        PUBLIC_PACKAGE_PLAY.run(
            {"levels": [str(file.resolve()) for file in files], "actions": str(array.resolve()), "num_seen": 1}, to
        )
    except (PeerMissing, RuntimeError) as error:
        raise UserError(str(error)) from None
    finally:
        array.unlink()


def read_published(file: Path, levels: list[Path], num_policies: int) -> tuple[Played, dict[str, str]]:
    with np.load(file) as archive:
        outcome, length, position = archive["outcome"], archive["length"], archive["position"]
        described = json.loads(str(archive["described"]))
    if outcome.shape != (len(levels), 1 + num_policies):
        raise UserError(f"{file} is of other levels or policies; remove it, and it is made again")
    seen = []
    for level, path in enumerate(levels):
        state = json.loads(path.read_text())["env_state"]
        active = [shape["active"] for shape in state["polygon"] + state["circle"]]
        seen.append(position[level, 0, : length[level, 0], active].swapaxes(0, 1))
    return Played(outcome=outcome, position=seen), described


def play_ours(files: list[Path], size: str, actions: np.ndarray, way: Way) -> Played:
    config = EnvConfig(size=size, max_steps=NUM_STEPS, frame_skip=way.frame_skip)
    env = Environment(config, engine=Engine(config.capacity, settings=way.settings))
    levels = []
    for file in files:
        level = fit_level(load_kinetix(file), config.capacity)
        levels.append(with_masses_of_file(level, file) if way.has_masses_of_file else level)
    num_worlds = actions.shape[1]
    outcome = np.zeros((len(levels), num_worlds), int)
    for number, level in enumerate(levels):
        played = Worlds(env, level, num_worlds).episodes(actions)
        is_finite = np.isfinite(played.position).all(axis=(1, 2))
        ended = np.where(played.is_over, np.where(is_finite, 2, 3), 0)
        outcome[number] = np.where(played.solved_after > 0, 1, ended)
    nobody = np.repeat(actions[:, :1], len(levels), axis=1)
    rollouts = record_actions(env, stack_worlds(levels), nobody)
    position = [rollout.position[1:][:, np.asarray(rollout.level.scene.shapes.active)] for rollout in rollouts]
    return Played(outcome=outcome, position=position)


def with_masses_of_file(level: Level, file: Path) -> Level:
    """The level with inverse masses and inertias of a public file, about the point that its corners are about."""
    state = json.loads(file.read_text())["env_state"]
    shapes = state["polygon"] + state["circle"]
    scene = level.scene
    active = scene.shapes.active
    there = np.array([[shape["position"][axis] for axis in "01"] for shape in shapes], np.float32)
    back = np.where(active[:, None], level.position - there, 0.0)  # from the file's origin to the centre of mass
    cos, sin = np.cos(level.angle), np.sin(level.angle)
    local = np.stack([cos * back[:, 0] + sin * back[:, 1], cos * back[:, 1] - sin * back[:, 0]], axis=1)
    local = local.astype(np.float32)
    inverse = {
        name: np.where(active, np.array([shape[name] for shape in shapes], np.float32), 0.0).astype(np.float32)
        for name in ("inverse_mass", "inverse_inertia")
    }
    moved = scene.replace(
        shapes={"vertices": scene.shapes.vertices + local[: len(state["polygon"]), None], **inverse},
        joints={
            "anchor_a": scene.joints.anchor_a + local[scene.joints.a],
            "anchor_b": scene.joints.anchor_b + local[scene.joints.b],
        },
        thrusters={"position": scene.thrusters.position + local[scene.thrusters.body]},
    )
    return dataclasses.replace(level, scene=moved, position=level.position - back)


def row_of(size: str, file: Path, level: int, theirs: Played, ours: dict[str, Played]) -> dict[str, Any]:
    their_outcome = theirs.outcome[level]
    row: dict[str, Any] = {
        "level": f"{size}/{file.stem}",
        "package": {"noop": OUTCOMES[their_outcome[0]], **rates(their_outcome[1:])},
    }
    for name, played in ours.items():
        outcome = played.outcome[level]
        row[name] = {
            "noop": OUTCOMES[outcome[0]],
            **rates(outcome[1:]),
            **paired(their_outcome[1:] == 1, outcome[1:] == 1),
            "noop_apart_after": apart_after(theirs.position[level], played.position[level]),
        }
    return row


def rates(outcome: np.ndarray) -> dict[str, float]:
    return {"solved": float(np.mean(outcome == 1)), "red": float(np.mean(outcome == 2))}


def paired(theirs: np.ndarray, ours: np.ndarray) -> dict[str, Any]:
    """What two outcomes [policies] bool of the same actions say: difference, its 95 % interval, exact p (McNemar)."""
    count = len(theirs)
    only_theirs, only_ours = int(np.sum(theirs & ~ours)), int(np.sum(ours & ~theirs))
    apart = only_theirs + only_ours
    difference = (only_ours - only_theirs) / count
    half = Z_95 * math.sqrt(max(apart - (only_ours - only_theirs) ** 2 / count, 0.0)) / count
    tail = sum(math.comb(apart, k) for k in range(min(only_theirs, only_ours) + 1)) / 2**apart
    return {
        "only_package": only_theirs,
        "only_ours": only_ours,
        "difference": difference,
        "interval": [difference - half, difference + half],
        "p": min(1.0, 2.0 * tail),
    }


def apart_after(theirs: np.ndarray, ours: np.ndarray) -> int | None:
    """Environment steps until some shape is APART_M from where the package has it; None: not before the first end.

    Shapes whose origins are not the same point in both are left out.
    """
    count = min(len(theirs), len(ours))
    offset = np.linalg.norm(theirs[:count] - ours[:count], axis=-1)
    same_origin = offset[0] < APART_M / 2
    is_apart = (offset[:, same_origin] > APART_M).any(axis=1)
    return int(np.argmax(is_apart)) + 1 if is_apart.any() else None


def show(rows: list[dict[str, Any]], ways: list[str]) -> None:
    print(f"{'level':34} {'noop, solved':>20}  " + "  ".join(f"{way:>26}" for way in ways))
    for row in rows:
        cells = [f"{row['package']['noop']:>12} {row['package']['solved']:7.0%}"]
        for way in ways:
            found = row[way]
            mark = "*" if found["p"] < DIFFERS_BELOW else " "
            noop = "" if found["noop"] == row["package"]["noop"] else found["noop"]
            cells.append(f"{noop:>10} {found['solved']:5.0%}{mark} p {found['p']:7.1e}")
        print(f"{row['level']:34} " + "  ".join(cells))
    for way in ways:
        differs = [row["level"] for row in rows if row[way]["p"] < DIFFERS_BELOW]
        noop = [row["level"] for row in rows if row[way]["noop"] != row["package"]["noop"]]
        mean = [float(np.mean([row[side]["solved"] for row in rows])) for side in ("package", way)]
        chance = sum(row[way]["p"] < 0.05 for row in rows)
        print(
            f"{way}: mean {mean[1]:.1%}, the package {mean[0]:.1%}; p < {DIFFERS_BELOW:g} in {len(differs)} of "
            f"{len(rows)}, p < 0.05 in {chance}; another end without actions in {len(noop)} ({', '.join(noop)})"
        )


def write_csv(file: Path, rows: list[dict[str, Any]]) -> None:
    """A line for each level and way."""
    records = []
    for row in rows:
        theirs = row["package"]
        for way in (name for name in row if name not in ("level", "package")):
            found = dict(row[way])
            low, high = found.pop("interval")
            package = {f"package_{name}": value for name, value in theirs.items()}
            records.append({"level": row["level"], "way": way, **package, **found, "low": low, "high": high})
    with file.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, list(records[0]))
        writer.writeheader()
        for record in records:
            writer.writerow({k: f"{v:.3g}" if isinstance(v, float) else v for k, v in record.items()})


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    sys.exit(main())
