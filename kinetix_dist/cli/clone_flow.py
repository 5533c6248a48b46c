"""`kinetix-dist clone-flow`: a policy of action chunks from data sets, by flow matching.

    kinetix-dist clone-flow --data data --run runs/flow
    kinetix-dist clone-flow --data data --run runs/flow_rtc --max-delay 8        for training-time RTC, too
    kinetix-dist bench delay --policy runs/flow runs/flow_rtc --levels levels --picture delay.png

The data are of `kinetix-dist collect` with continuous actions. A checkpoint is written at each quarter of the steps;
progress.jsonl has the loss on data that were learned from and on held-out episodes. docs/delay.md explains it.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from kinetix_dist.cli.checks import check_seed, start_computing
from kinetix_dist.delay.chunk_policy import FlowConfig
from kinetix_dist.delay.cloning import CloningConfig
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.delay.cloning import Progress

PROGRESS_NAME = "progress.jsonl"
NUM_CHECKPOINTS = 4
NETWORKS = {"flat": "flat", "pixels": "cnn"}  # by observation, where it is not that of entities


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args:
    """Train a policy of action chunks on data sets, by flow matching."""

    data: tuple[Path, ...]
    """Data sets of `kinetix-dist collect`, of continuous actions and one kind of environment."""
    run: Path
    """New directory for checkpoints and losses."""
    solved_only: bool = False
    """Learn from episodes that ended solved alone."""
    skip_damaged: bool = False
    """Leave out shards that are missing or damaged, and say how many."""
    flow: Annotated[FlowConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=FlowConfig)
    training: Annotated[CloningConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=CloningConfig)

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError("--data is empty")


def run(args: Args) -> int:
    check_seed(args.training.seed)
    if (args.run / "checkpoints").exists():
        raise UserError(f"{args.run} holds checkpoints; choose another --run")
    start_computing()
    from kinetix_dist.data import DatasetError
    from kinetix_dist.delay.chunk_policy import make_chunk_policy
    from kinetix_dist.delay.cloning import clone
    from kinetix_dist.delay.demonstrations import open_demonstrations, samples_of
    from kinetix_dist.env.environment import Environment
    from kinetix_dist.models.policy import num_parameters

    with user_errors(DatasetError, ValueError, OSError):
        demonstrations = open_demonstrations(args.data, skip_damaged=args.skip_damaged)
        config = _for_observation(args.flow, demonstrations.env_config.observation)
        env = Environment(demonstrations.env_config)
        policy = make_chunk_policy(config, env)
        samples = samples_of(demonstrations, policy, solved_only=args.solved_only)
        args.run.mkdir(parents=True, exist_ok=True)
    skipped = sum(len(each.skipped) for each in demonstrations.datasets)
    print(
        f"{len(samples.level):,} transitions of {len(samples.bound)} levels, chunks of {config.horizon} actions"
        + (f"; {skipped} shards are damaged or missing and left out" if skipped else ""),
        flush=True,
    )
    report = _Report(args, config, demonstrations.description, demonstrations.env_config)
    with user_errors(ValueError, OSError):
        params = clone(policy, env, samples, args.training, max_delay=config.max_delay, on_report=report)
    print(f"{num_parameters(params):,} parameters in {report.newest}")
    print(f"play it   kinetix-dist bench delay --policy {args.run} --levels SET --picture {args.run / 'delay.png'}")
    return 0


class _Report:
    """Prints and stores losses, and writes checkpoints."""

    def __init__(self, args: Args, config: FlowConfig, data: list[dict[str, Any]], env: Any) -> None:
        self._args, self._config, self._data, self._env = args, config, data, env
        self._began = time.monotonic()
        self._saved = 0  # quarters
        self.newest: Path | None = None

    def __call__(self, progress: Progress) -> None:
        from kinetix_dist.delay.chunk_policy import save_chunk_policy

        steps, seconds = self._args.training.steps, time.monotonic() - self._began
        losses = {"loss": progress.loss, "held_out_loss": progress.held_out_loss}
        with (self._args.run / PROGRESS_NAME).open("a") as file:
            file.write(json.dumps({"step": progress.steps, "seconds": round(seconds, 1)} | losses) + "\n")
        print(
            f"step {progress.steps:,} of {steps:,}  {seconds:.0f} s  loss {progress.loss:.4f}  "
            f"held out {progress.held_out_loss:.4f}",
            flush=True,
        )
        if (quarters := NUM_CHECKPOINTS * progress.steps // steps) > self._saved:
            self._saved = quarters
            notes = losses | {"data": self._data, "training": dataclasses.asdict(self._args.training)}
            folder = self._args.run / "checkpoints"
            self.newest = save_chunk_policy(
                folder, progress.steps, progress.params, self._config, self._env, notes=notes
            )


def _for_observation(config: FlowConfig, observation: str) -> FlowConfig:
    """The network that reads what the data hold, where none was chosen."""
    if observation not in NETWORKS or config.encoder.network != FlowConfig().encoder.network:
        return config
    return dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, network=NETWORKS[observation]))
