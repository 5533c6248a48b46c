"""`kinetix-dist quickstart`: a first experiment on two CPU cores, in minutes. `make train` runs it.

    kinetix-dist quickstart                       in runs/quickstart, numbered if there is one
    kinetix-dist quickstart --run runs/mine       in another directory
    kinetix-dist quickstart --resume              goes on where it was stopped

1. `train --recipe quickstart`: random levels; solve rates of held-out ones before and after.
2. `finetune --recipe quickstart_finetune --levels quickstart_s --each --compare --stop-at 0.9`: two hand-made levels
   that the policy never saw, trained on from that policy and from scratch.
3. A moving picture of both levels, before and after the second part.

All options of `train` but --recipe and --from hold for the first part.
"""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kinetix_dist.cli import finetune, train
from kinetix_dist.cli.option_help import wants_help
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.config import RunConfig

PROG = "kinetix-dist quickstart"
RECIPE, FINETUNE_RECIPE = "quickstart", "quickstart_finetune"
LEVELS = "quickstart_s"
STOP_AT = 0.9
RESULTS_NAME, GIF_NAME = "finetune", "finetuned.gif"
USAGE = f"""usage: {PROG} [--run DIR] [--resume] [options of train]

  --run DIR       directory of the run (default runs/{RECIPE}, numbered if there is one)
  --resume        go on with the run in --run, or with the newest one

Trains the recipe {RECIPE!r}, then fine-tunes on the levels {LEVELS} and from scratch beside it, and draws how they are
played. `kinetix-dist train --help` shows the options of the first part.
"""


def parse(argv: Sequence[str]) -> train.Args:
    if wants_help(argv):
        print(USAGE)
        raise SystemExit(0)
    for option, instead in (("--recipe", "train --recipe NAME"), ("--from", "train --from CKPT")):
        if any(word.split("=")[0] == option for word in argv):
            raise UserError(f"{PROG} has no {option}; `kinetix-dist {instead}` trains without the other parts")
    return train.parse(["--recipe", RECIPE, *argv] if "--resume" not in argv else argv, prog=PROG)


def run(args: train.Args) -> int:
    _say(
        f"1 of 3  training on random levels (recipe {RECIPE}), then solve rates of held-out ones: random_s is like "
        "those\n        of training, random actions rarely solve frontier_s"
    )
    status, path = train.run_in(args)
    if path is None:
        return status
    _say(
        "2 of 3  two hand-made levels that it never saw: how many environment steps (env steps) until "
        f"{STOP_AT:.0%} of\n        100 attempts are solved, from the policy just trained, and from scratch?"
    )
    tuning = _finetuning(path, args.config.run)
    status = finetune.run(tuning)
    if status == 0:
        _say(f"3 of 3  both levels as they are played, before and after part 2: open {tuning.gif}")
    return status


def _finetuning(path: Path, trained: RunConfig) -> finetune.Args:
    """Arguments of the second part for the run of the first: its directory and settings."""
    results = path / RESULTS_NAME
    with user_errors(OSError):
        results.mkdir(exist_ok=True)
    args = finetune.parse(
        (
            *("--recipe", FINETUNE_RECIPE, "--levels", LEVELS, "--from", str(path)),
            *("--each", "--compare", "--stop-at", str(STOP_AT)),
            *("--run", str(results), "--gif", str(results / GIF_NAME)),
        )
    )
    assert args.train is not None
    config = args.train.config
    same = {name: getattr(trained, name) for name in ("seed", "device", "compile_cache")}
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, **same))
    return dataclasses.replace(
        args,
        train=dataclasses.replace(args.train, config=config),
        go_on=f"`{PROG} --resume --run {shlex.quote(str(path))}` goes on",
    )


def _say(text: str) -> None:
    say(f"\n{text}\n", sys.stdout)
