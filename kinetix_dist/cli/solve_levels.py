"""`kinetix-dist levels solve`: finds proofs that levels can be solved, stores them, and checks those that there are.

    kinetix-dist levels solve s/hop_home                  search, store levels/proofs/s/hop_home.json
    kinetix-dist levels solve mine.json --seconds 300     search longer, store mine.proof.json
    kinetix-dist levels solve all_designed_s --check      replay what is stored, search nothing
    kinetix-dist levels solve s/hop_home --check --picture solved.png

Exit status 1 where a level stays without a proof, or a proof does not solve its level.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import math
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from kinetix_dist.cli.checks import check_output_directory, check_output_file, check_seed
from kinetix_dist.errors import UserError, one_line, user_errors

if TYPE_CHECKING:
    from kinetix_dist.env.environment import Environment
    from kinetix_dist.evaluation.policies import Player
    from kinetix_dist.level.level import Level
    from kinetix_dist.level.proof import Proof
    from kinetix_dist.telemetry.recording import Rollout

MIN_WORLDS = 32  # fewer leave the searches nothing to choose from
PIXELS_PER_METRE = 40.0  # of pictures: 40 levels on one are 1,500 pixels wide


@dataclasses.dataclass(frozen=True)
class Solve:
    """Find actions that solve levels, and store them as proofs; or check the proofs that there are."""

    levels: tyro.conf.Positional[str]
    """A level file, a designed level such as s/hop_home, a set or a directory of level files."""
    check: bool = False
    """Replay the stored proofs instead of searching."""
    picture: Path | None = None
    """With --check: also draw how the proofs end, all levels on one PNG."""
    again: bool = False
    """Search also where a good proof is stored, and replace it."""
    seconds: float = 60.0
    """To search for each level."""
    method: Literal["stored", "random", "best_first", "cem", "policy"] | None = None
    """The only method to try; left out: all of them, policy only with --checkpoint, stored where there is a proof."""
    checkpoint: Path | None = None
    """Whose policy --method policy plays: a checkpoint directory, or a pretrained policy such as generalist."""
    proofs: Path | None = None
    """The directory of the proofs; left out: levels/proofs for designed levels, else next to each level file."""
    worlds: int = 512
    """Worlds played at once."""
    seed: int = 0
    """Seed of the search."""
    preset: Annotated[str, tyro.conf.arg(name="env.preset")] = "standard"
    """Solver settings of the physics."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProofTask:
    """A level and where its proof is."""

    name: str
    size: str
    level: Level
    document: dict[str, Any]
    proof_file: Path


def run_solve(args: Solve) -> int:
    """0, or 1 where a level is without a good proof at the end."""
    _check(args)
    from kinetix_dist.cli.checks import start_computing

    start_computing("")
    with user_errors(ValueError, OSError):
        tasks = proof_tasks(args)
    if args.check:
        return _check_proofs(args, tasks)
    return _search(args, tasks)


def _check(args: Solve) -> None:
    """Complains before anything slow happens."""
    from jax2d.settings import preset

    with user_errors(ValueError):
        preset(args.preset)
    if args.seconds <= 0:
        raise UserError(f"--seconds is {args.seconds}; give more than 0")
    if args.worlds < MIN_WORLDS:
        raise UserError(f"--worlds is {args.worlds}; give {MIN_WORLDS} or more")
    check_seed(args.seed)
    if args.method == "policy" and args.checkpoint is None:
        raise UserError(
            "--method policy needs --checkpoint: a checkpoint directory, or a pretrained policy (generalist)"
        )
    if args.checkpoint is not None and args.method not in (None, "policy"):
        raise UserError(f"--method {args.method} plays no policy; leave --checkpoint out")
    if args.check and (args.again or args.method or args.checkpoint):
        raise UserError("--check searches nothing; leave --again, --method and --checkpoint out")
    if args.picture is not None and not args.check:
        raise UserError("--picture draws what --check replays; give --check too")
    if args.picture is not None:
        check_output_file(args.picture, "--picture")
    if args.proofs is not None:
        check_output_directory(args.proofs, "--proofs")


def proof_tasks(args: Solve) -> list[ProofTask]:
    """One of each requested level. Raises ValueError or OSError for what is no level or has no files."""
    from kinetix_dist.level.fit import capacity_of_size, fit_level
    from kinetix_dist.level.proof import proof_path
    from kinetix_dist.level.sets import files_of_set, level_names, read_level
    from kinetix_dist.level.validate import read_document

    tasks, files = [], files_of_set(args.levels)
    for file, name in zip(files, level_names(files), strict=True):
        level, info = read_level(file)
        tasks.append(
            ProofTask(
                name=name,
                size=info.size,
                level=fit_level(level, capacity_of_size(info.size)),
                document=read_document(file),
                proof_file=proof_path(file) if args.proofs is None else args.proofs / f"{name}.json",
            )
        )
    return tasks


@functools.cache  # what is compiled for one belongs to it
def _environment(preset_name: str, size: str) -> Environment:
    from jax2d.settings import preset
    from kinetix_dist.env.environment import EnvConfig, Environment

    return Environment(EnvConfig(size=size, physics=preset(preset_name)))


def _by_size(tasks: Iterable[ProofTask]) -> dict[str, list[ProofTask]]:
    """Tasks by size: one environment, compiled once, for all of a size."""
    grouped = collections.defaultdict(list)
    for task in tasks:
        grouped[task.size].append(task)
    return grouped


def _check_proofs(args: Solve, tasks: list[ProofTask]) -> int:
    replayed = replay_proofs(args, tasks)
    for task, proof, rollout, fault in replayed:
        if fault is None:
            assert proof is not None and rollout is not None
            claimed = "" if rollout.num_steps == proof.num_steps else f" (the proof: {proof.num_steps})"
            share = _robustness(args, task, proof)
            before = "" if proof.robustness is None else f" (the proof: {proof.robustness:.0%})"
            also = f"also from {share:.0%} of slightly different starts"
            print(f"{task.name}: solved in {rollout.num_steps} steps{claimed}, {also}{before}", flush=True)
        else:
            print(f"{task.name}: {fault}")
    num_good = sum(fault is None for *_, fault in replayed)
    print(f"{num_good} of {len(tasks)} levels have a proof that solves them")
    if args.picture is not None:
        _write_picture(args.picture, [rollout for _, _, rollout, _ in replayed if rollout is not None])
    return 0 if num_good == len(tasks) else 1


def _robustness(args: Solve, task: ProofTask, proof: Proof) -> float:
    """Share of slightly different starts from which a proof solves its level with this engine."""
    from kinetix_dist.evaluation.search.polish import robustness
    from kinetix_dist.evaluation.search.worlds import Worlds

    worlds = Worlds(_environment(args.preset, task.size), task.level, args.worlds)
    starts = worlds.different_starts(np.random.default_rng(args.seed))
    return robustness(worlds, starts, [proof.actions])[0]


def _write_picture(path: Path, rollouts: list[Rollout]) -> None:
    """Draws the end of each rollout, in rows that make the picture about square."""
    from jax2d.images import film_strip, write_png
    from kinetix_dist.telemetry.pictures import moment_picture

    if not rollouts:
        raise UserError("no proof could be replayed: there is nothing to draw")
    images = [moment_picture(rollout, rollout.num_steps, pixels_per_metre=PIXELS_PER_METRE) for rollout in rollouts]
    columns = math.ceil(math.sqrt(len(images)))
    with user_errors(OSError, prefix=f"{path} cannot be written: "):
        write_png(path, film_strip(images, [rollout.level_name for rollout in rollouts], columns=columns))
    print(f"wrote {path}")


def replay_proofs(
    args: Solve, tasks: list[ProofTask]
) -> list[tuple[ProofTask, Proof | None, Rollout | None, str | None]]:
    """Replays of proofs: of each level its proof, its rollout, and its fault in one line (None: none)."""
    from kinetix_dist.evaluation.proofs import fault_of_replay, replay

    results: list[tuple[ProofTask, Proof | None, Rollout | None, str | None]] = []
    for size, of_size in _by_size(tasks).items():
        env = _environment(args.preset, size)
        good: list[tuple[ProofTask, Proof]] = []
        for task in of_size:
            if not task.proof_file.is_file():
                results.append((task, None, None, f"there is no proof ({task.proof_file})"))
                continue
            try:
                good.append((task, _proof_of(args, task, env)))
            except (ValueError, OSError) as error:
                results.append((task, None, None, one_line(error)))
        if good:
            rollouts = replay(env, [task.level for task, _ in good], [proof for _, proof in good])
            for (task, proof), rollout in zip(good, rollouts):
                results.append((task, proof, rollout, fault_of_replay(proof, rollout)))
    order = {id(task): number for number, task in enumerate(tasks)}
    return sorted(results, key=lambda result: order[id(result[0])])


def _proof_of(args: Solve, task: ProofTask, env: Environment) -> Proof:
    """The stored proof of a level. Raises `LevelFormatError` where it cannot be read or is of something else."""
    from kinetix_dist.level.proof import check_proof_is_of, read_proof

    proof = read_proof(task.proof_file)
    frame_skip, max_steps = env.config.frame_skip, env.config.max_steps
    check_proof_is_of(
        proof, task.proof_file, task.document, preset=args.preset, frame_skip=frame_skip, max_steps=max_steps
    )
    return proof


def _stored_actions(args: Solve, task: ProofTask, env: Environment) -> np.ndarray | None:
    """[t, 6] of the stored proof, whether it still holds or not; None where there is none, or of something else."""
    if not task.proof_file.is_file():
        return None
    try:
        return _proof_of(args, task, env).actions
    except (ValueError, OSError) as error:
        print(f"{task.name}: the stored proof is of no use: {one_line(error)}", flush=True)
        return None


def _search(args: Solve, tasks: list[ProofTask]) -> int:
    from kinetix_dist.evaluation.search.solve import Target, solve
    from kinetix_dist.level.proof import write_proof

    good = (
        {} if args.again else {id(task): proof for task, proof, _, fault in replay_proofs(args, tasks) if fault is None}
    )
    num_solved = 0
    for size, of_size in _by_size(tasks).items():
        env = _environment(args.preset, size)
        for task in of_size:
            proof = good.get(id(task))
            if proof is not None:
                print(f"{task.name}: has a proof of {proof.num_steps} steps (--again searches for another)")
                num_solved += 1
                continue
            with user_errors(OSError, prefix=f"{task.proof_file} cannot be written: "):
                task.proof_file.parent.mkdir(parents=True, exist_ok=True)  # before the search, not after it
                if not os.access(task.proof_file.parent, os.W_OK):
                    raise UserError(f"{task.proof_file.parent} cannot be written to; give --proofs another directory")
            begin = time.monotonic()
            with user_errors(ValueError, prefix=f"{task.name}: "):
                target = Target(
                    name=task.name,
                    level=task.level,
                    document=task.document,
                    player=_player(args, env, task.level),
                    stored=_stored_actions(args, task, env),
                )
                solved = solve(
                    env,
                    target,
                    seconds=args.seconds,
                    methods=None if args.method is None else [args.method],
                    num_worlds=args.worlds,
                    seed=args.seed,
                )
            seconds = time.monotonic() - begin
            if solved.proof is None:
                print(f"{task.name}: not solved in {seconds:.0f} s; tried {'; '.join(solved.tried)}", flush=True)
                continue
            with user_errors(OSError, prefix=f"{task.proof_file} cannot be written: "):
                write_proof(task.proof_file, solved.proof)
            num_solved += 1
            proof = solved.proof
            print(
                f"{task.name}: solved in {proof.num_steps} steps by {proof.method} after {seconds:.0f} s, "
                f"also from {proof.robustness:.0%} of slightly different starts; wrote {task.proof_file}",
                flush=True,
            )
    print(f"{num_solved} of {len(tasks)} levels have a proof")
    return 0 if num_solved == len(tasks) else 1


def _player(args: Solve, env: Environment, level: Level) -> Player | None:
    """The policy of --checkpoint; None without one."""
    if args.checkpoint is None:
        return None
    from jax2d.scene import stack_worlds
    from kinetix_dist.trained_policy import checkpoint_at

    return checkpoint_at(args.checkpoint).player(env, stack_worlds([level]))
