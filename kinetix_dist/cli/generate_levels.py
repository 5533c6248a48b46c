"""`kinetix-dist levels generate DIR`: writes new levels, without levels that solve themselves.

    kinetix-dist levels generate mine --size m --count 50            by a random generator
    kinetix-dist levels generate mine --like my_levels               by a model that learns what those levels are like
    kinetix-dist levels generate mine --teacher runs/paired_s        by the teacher of a PAIRED run
    kinetix-dist levels generate mine --body car                     a car below a goal that it cannot touch

The files play wherever levels are requested: `kinetix-dist edit mine`, `eval --levels mine`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from kinetix_dist import prng
from kinetix_dist.atomic_directories import new_directory
from kinetix_dist.cli.checks import check_output_directory, check_seed
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.level.generator import LevelGenerator
    from kinetix_dist.level.level import Level

MAX_ROUNDS = 8  # each draws the requested number of levels, until enough of them do not solve themselves


@dataclasses.dataclass(frozen=True)
class Generate:
    """Write new levels: random levels, levels similar to a set, or levels of a teacher."""

    out: tyro.conf.Positional[Path]
    """The directory to write into, new or empty."""
    count: int = 24
    """How many levels."""
    size: Literal["s", "m", "l"] | None = None
    """Size of random levels, "m" if left out; other levels have the size of the set or the run."""
    generator: str | None = None
    """Which random levels: "default", "kinetix", "locomotion", "tasks" or one of its families, such as "car"."""
    like: str | None = None
    """Levels similar to this set, directory or random set (random_s, ...): an autoencoder is trained on it."""
    steps: int | None = None
    """With --like: gradient steps of the autoencoder; left out: its default."""
    teacher: Path | None = None
    """Levels that the teacher of this run (curriculum paired) builds with its newest checkpoint."""
    body: str | None = None
    """Levels of goal following with such a body: car, snake, thrusters or random (`kinetix-dist bench goals`)."""
    seed: int = 0
    """Seed of the draw, and of the training of the autoencoder."""


def run_generate(args: Generate) -> int:
    """Write all levels or none; return 0."""
    _check(args)
    from kinetix_dist.cli.checks import start_computing

    start_computing("")
    with user_errors(ValueError, OSError), new_directory(args.out) as draft:  # before the work, not after it
        source, size, prefix = _source(args)
        levels, num_drawn, num_solved = _draw(args, source)
        _write(draft, levels, size, prefix)
    print(
        f"wrote {args.count} levels of size {size} to {args.out}; of {num_drawn} drawn {num_solved} solve themselves "
        "and are left out"
    )
    return 0


def _check(args: Generate) -> None:
    """Complains before anything slow happens."""
    given = [name for name in ("generator", "like", "teacher", "body") if getattr(args, name) is not None]
    if len(given) > 1:
        raise UserError(f"--{given[0]} and --{given[1]} both say where levels come from; give one")
    if args.count < 1:
        raise UserError(f"--count is {args.count}; give 1 or more")
    check_seed(args.seed)
    if args.size is not None and given and given[0] not in ("generator", "body"):
        raise UserError(f"--size is for random levels; with --{given[0]} levels have the size of what they come from")
    if args.steps is not None and args.like is None:
        raise UserError("--steps is for the autoencoder of --like; give a set of levels or leave it out")
    check_output_directory(args.out)


def _source(args: Generate) -> tuple[LevelGenerator, str, str]:
    """Source of levels, their size, and the names of their files."""
    from kinetix_dist.level.fit import capacity_of_size
    from kinetix_dist.level.generator import RandomLevels
    from kinetix_dist.level.generator_config import generator

    if args.like is not None:
        return *_model(args, args.like), "like"
    if args.teacher is not None:
        from kinetix_dist.config import curriculum_from_dict
        from kinetix_dist.curator.teacher import teacher_levels
        from kinetix_dist.trained_policy import newest_checkpoint_of

        trained, _ = newest_checkpoint_of(args.teacher)
        size, checkpoint = trained.config.env.size, trained.checkpoint
        with user_errors(ValueError, prefix=f"checkpoint {checkpoint.path}: "):
            curriculum = curriculum_from_dict(checkpoint.config)
        return teacher_levels(checkpoint, curriculum, capacity_of_size(size)), size, "taught"
    if args.body is not None:
        from kinetix_dist.level.goal_following import GoalFollowingLevels, size_for

        size = args.size or size_for(args.body)
        return GoalFollowingLevels(capacity_of_size(size), args.body), size, args.body
    size = args.size or "m"
    return RandomLevels(capacity_of_size(size), generator(args.generator or "default")), size, "random"


def _model(args: Generate, like: str) -> tuple[LevelGenerator, str]:
    """An autoencoder of the levels of a set, trained, and their size."""
    import numpy as np

    from jax2d.scene import index_worlds
    from kinetix_dist.level.fit import capacity_of, capacity_of_size
    from kinetix_dist.level.generator_config import generator
    from kinetix_dist.level.level import SIZES
    from kinetix_dist.level.sets import load_level_set
    from kinetix_dist.level.vectors import check_describable
    from kinetix_dist.models.level_vae import VaeConfig, fit

    config = VaeConfig() if args.steps is None else VaeConfig(num_steps=args.steps)
    levels, names = load_level_set(like)
    for number, name in enumerate(names):
        with user_errors(ValueError, prefix=f"{like}: {name}: "):
            check_describable(index_worlds(levels, slice(number, number + 1)))
    size = next(name for name in SIZES if capacity_of_size(name) == capacity_of(levels))
    print(f"training on {len(names)} levels of size {size}: {config.num_steps} steps", flush=True)
    model, losses = fit(levels, prng.key(args.seed), capacity_of_size(size), generator("default"), config)
    tenth = max(1, config.num_steps // 10)
    first, last = (float(np.asarray(part).mean()) for part in (losses[:tenth], losses[-tenth:]))
    print(f"loss {first:.3g} in the first tenth, {last:.3g} in the last", flush=True)
    return model, size


def _draw(args: Generate, source: LevelGenerator) -> tuple[list[Level], int, int]:
    """Return `count` levels that do not solve themselves, the number drawn, and the number that solve themselves."""
    import jax
    import numpy as np

    from jax2d.scene import index_worlds
    from kinetix_dist.level.simulation import NOOP_STEPS, noop_solved

    unsolved: list[Level] = []
    num_drawn = num_solved = 0
    key = prng.fold_in(prng.key(args.seed), 1)
    generate = jax.jit(source.generate, static_argnums=1)
    for number in range(MAX_ROUNDS):
        levels = jax.device_get(generate(prng.fold_in(key, number), args.count))
        is_solved = np.asarray(noop_solved(levels))
        num_drawn, num_solved = num_drawn + args.count, num_solved + int(is_solved.sum())
        unsolved += [index_worlds(levels, i) for i in np.flatnonzero(~is_solved)]
        if len(unsolved) >= args.count:
            return unsolved[: args.count], num_drawn, num_solved
    raise UserError(
        f"of {num_drawn} levels drawn only {len(unsolved)} do not solve themselves within {NOOP_STEPS} steps; ask for "
        "fewer, or for others"
    )


def _write(out: Path, levels: list[Level], size: str, prefix: str) -> None:
    from kinetix_dist.level.schema import LevelInfo, save_level

    digits = len(str(len(levels) - 1))
    for number, level in enumerate(levels):
        name = f"{prefix}_{number:0{digits}}"
        save_level(level, out / f"{name}.json", LevelInfo(name=name, size=size))
