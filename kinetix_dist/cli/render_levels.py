"""`kinetix-dist levels render`: levels as pictures, how they start or how they are played; one, or many in a grid.

    kinetix-dist levels render s/hop_home start.png                      how it starts
    kinetix-dist levels render s/hop_home proof.gif --by proof           its proof, moving
    kinetix-dist levels render l/walker moments.png --by random          moments of a rollout side by side
    kinetix-dist levels render random_m grid.gif --by trained --checkpoint generalist --count 6
    kinetix-dist levels render all_designed_m grid.png                   a grid of starts

No display, no GPU and no system package is needed. GIFs are in real time; there is no MP4, which needs a video encoder.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from kinetix_dist import prng
from kinetix_dist.cli.checks import check_output_file, check_seed
from kinetix_dist.errors import UserError, one_line, user_errors

if TYPE_CHECKING:
    from kinetix_dist.level.level import Level
    from kinetix_dist.telemetry.recording import Rollout

START_SCALE, ROLLOUT_SCALE = 100.0, 60.0  # pixels per metre of one level; those of a grid are smaller


@dataclasses.dataclass(frozen=True)
class Render:
    """Draw levels as PNG (how they start, or moments of a rollout) or GIF (a rollout), without a display."""

    levels: tyro.conf.Positional[str]
    """A level file, a designed level such as s/hop_home, a set (random_s to random_l too) or a directory."""
    out: tyro.conf.Positional[Path]
    """The picture to write: .png, or .gif of a rollout."""
    by: Literal["start", "noop", "random", "proof", "trained"] = "start"
    """Pictures of: the start alone, or a rollout without actions, with random ones, by the stored proof, or by
    the policy of --checkpoint."""
    checkpoint: Path | None = None
    """Whose policy --by trained plays: a checkpoint directory, or a pretrained policy such as generalist."""
    count: int = 24
    """At most so many levels of a set, the first ones."""
    columns: int | None = None
    """Columns of a grid; left out: about a third more than rows."""
    seed: int = 0
    """Seed of the actions drawn."""
    preset: Annotated[str | None, tyro.conf.arg(name="env.preset")] = None
    """Solver settings of the physics; left out: those of the checkpoint, else standard."""


def run_render(args: Render) -> int:
    """0; 1 where a proof that is shown does not solve its level."""
    _check(args)
    if args.by == "proof":
        rollouts, faults = _proofs(args)
    else:
        rollouts, faults = ([], []) if args.by == "start" else (_rollouts(args), [])
    with user_errors(OSError, prefix=f"{args.out} cannot be written: "):
        if args.by == "start":
            _draw_starts(args)
        else:
            _draw_rollouts(args, rollouts)
    for fault in faults:
        print(fault)
    for rollout in rollouts:
        print(f"{rollout.level_name}: {rollout.outcome} after {rollout.num_steps} steps")
    print(f"wrote {args.out}")
    return 1 if faults else 0


def _check(args: Render) -> None:
    """Complains before anything slow happens."""
    suffix = args.out.suffix.lower()
    if suffix not in (".png", ".gif"):
        raise UserError(f"{args.out} is neither .png nor .gif; name a picture of one of these formats")
    if args.by == "start" and suffix == ".gif":
        raise UserError("how a level starts does not move; name a .png, or give --by noop, random, proof or trained")
    if (args.by == "trained") != (args.checkpoint is not None):
        raise UserError(
            "--by trained needs --checkpoint, and nothing else takes one: a directory, or such as generalist"
        )
    for name, number in (("count", args.count), ("columns", args.columns)):
        if number is not None and number < 1:
            raise UserError(f"--{name} is {number}; give 1 or more")
    check_seed(args.seed)
    check_output_file(args.out)


def _levels(args: Render) -> tuple[Level, list[str]]:
    """A batch of the levels to show, and their names."""
    import jax

    from kinetix_dist.level.sets import RANDOM_SETS, load_level_set

    with user_errors(ValueError, OSError):
        if args.levels in RANDOM_SETS:
            count = min(args.count, RANDOM_SETS[args.levels].num_levels)
            return load_level_set(args.levels, num_levels=count)
        levels, names = load_level_set(args.levels)
    return jax.tree.map(lambda x: x[: args.count], levels), names[: args.count]


def _rollouts(args: Render) -> list[Rollout]:
    """One rollout of each level, without actions, with random ones or by a policy."""

    from kinetix_dist.cli import eval_command
    from kinetix_dist.cli.checks import start_computing
    from kinetix_dist.evaluation.recordings import record_rollouts

    assert args.by in ("noop", "random", "trained")
    requested = eval_command.Args(
        levels=args.levels, checkpoint=args.checkpoint, policy=args.by, preset=args.preset, baselines=False
    )
    eval_command.check(requested)
    trained = eval_command.trained_of(requested)
    start_computing()
    levels, names = _levels(args)
    env = eval_command.environment_of(requested.preset, trained, levels)
    player = eval_command.players_of(requested, trained, env, levels)[args.by]
    return record_rollouts(env, player, levels, prng.key(args.seed), names=names, seed=args.seed)


def _proofs(args: Render) -> tuple[list[Rollout], list[str]]:
    """Replays of the stored proofs, and what is wrong with some."""
    from kinetix_dist.cli.solve_levels import Solve, proof_tasks, replay_proofs

    requested = Solve(levels=args.levels, check=True, preset=args.preset or "standard")
    with user_errors(ValueError, OSError):
        replayed = replay_proofs(requested, proof_tasks(requested)[: args.count])
    faults = [f"{task.name}: {one_line(fault)}" for task, _, _, fault in replayed if fault is not None]
    rollouts = [rollout for _, _, rollout, _ in replayed if rollout is not None]
    if not rollouts:
        raise UserError(f"no proof can be shown; {faults[0]}")
    return rollouts, faults


def _columns(args: Render, number: int) -> int:
    return min(number, args.columns or math.ceil(math.sqrt(1.3 * number)))


def _draw_starts(args: Render) -> None:
    from jax2d.draw import draw
    from jax2d.images import film_strip, write_png
    from jax2d.scene import index_worlds
    from kinetix_dist.level.simulation import start_state
    from kinetix_dist.telemetry.pictures import grid_scale

    levels, names = _levels(args)
    scale = grid_scale(_columns(args, len(names)), of_one=START_SCALE)
    singles = [index_worlds(levels, number) for number in range(len(names))]
    images = [
        draw(level.scene, start_state(level), roles=level.shape_role, pixels_per_metre=scale) for level in singles
    ]
    is_one = len(images) == 1
    write_png(args.out, images[0] if is_one else film_strip(images, names, columns=_columns(args, len(images))))


def _draw_rollouts(args: Render, rollouts: list[Rollout]) -> None:
    from jax2d.images import write_png
    from kinetix_dist.telemetry.pictures import (
        grid_picture,
        grid_scale,
        write_grid_gif,
        write_rollout_gif,
        write_rollout_picture,
    )

    number = len(rollouts)
    if args.out.suffix.lower() == ".gif":
        scale = grid_scale(_columns(args, number), of_one=ROLLOUT_SCALE)
        if number == 1:
            write_rollout_gif(args.out, rollouts[0], pixels_per_metre=scale)
        else:
            write_grid_gif(args.out, rollouts, pixels_per_metre=scale, columns=_columns(args, number))
    elif number == 1:
        write_rollout_picture(args.out, rollouts[0])
    else:
        scale = grid_scale(_columns(args, number), of_one=ROLLOUT_SCALE)
        longest = max(rollout.num_steps for rollout in rollouts)
        picture = grid_picture(rollouts, longest, pixels_per_metre=scale, columns=_columns(args, number))
        write_png(args.out, picture)
