"""`kinetix-dist clone-flow`: a policy of action chunks from data sets, by flow matching.

    kinetix-dist clone-flow --data data --run runs/flow
    kinetix-dist clone-flow --data data --run runs/flow_rtc --max-delay 8        for training-time RTC, too
    kinetix-dist bench delay --policy runs/flow runs/flow_rtc --levels levels --picture delay.png

The data are of `kinetix-dist collect` with continuous actions. A checkpoint is written at each quarter of the steps;
progress.jsonl has the loss on data that were learned from and on held-out episodes. The same command goes on with a
training that was stopped or killed, and with more --steps it trains one further. docs/delay.md explains it.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import tyro

from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.cli.checks import check_output_directory, check_seed, start_computing
from kinetix_dist.cli.streams import say
from kinetix_dist.delay.chunk_policy import FlowConfig
from kinetix_dist.delay.cloning import CloningConfig
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.delay.chunk_policy import ChunkPolicy
    from kinetix_dist.delay.cloning import Progress
    from kinetix_dist.delay.demonstrations import Demonstrations
    from kinetix_dist.delay.windows import Samples
    from kinetix_dist.env.environment import Environment
    from kinetix_dist.runtime import StopSignals

HINT = "; the same command goes on"
NUM_CHECKPOINTS = 4
NETWORKS = {"flat": "flat", "pixels": "cnn"}  # by observation, where it is not that of entities


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args:
    """Train a policy of action chunks on data sets, by flow matching."""

    data: tuple[Path, ...]
    """Data sets of `kinetix-dist collect`, of continuous actions and one kind of environment."""
    run: Path
    """Directory for checkpoints and losses: a new one, or one of the same command, which goes on."""
    solved_only: bool = False
    """Learn from episodes that ended solved alone."""
    skip_damaged: bool = False
    """Leave out shards that are missing or damaged, and say how many."""
    save_seconds: float = 60.0
    """Time between saved states, from which the same command goes on; they are written when losses are."""
    flow: Annotated[FlowConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=FlowConfig)
    training: Annotated[CloningConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=CloningConfig)

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError("--data is empty")
        if not 0 <= self.save_seconds < math.inf:
            raise ValueError(f"--save-seconds is {self.save_seconds:g}; give a number of seconds, 0 or more")


def run(args: Args) -> int:
    check_seed(args.training.seed)
    check_output_directory(args.run, "--run")
    start_computing()
    from kinetix_dist.delay.cloning_state import DESIGN_NAME
    from kinetix_dist.runtime import (
        EXIT_STOPPED,
        LOCK_NAME,
        RunDirectoryError,
        StopRequested,
        StopSignals,
        lock_directory,
    )

    names = {path.name for path in args.run.iterdir()} if args.run.is_dir() else set()
    if names - {LOCK_NAME} and DESIGN_NAME not in names:
        raise UserError(f"{args.run} is not empty, and holds no training of clone-flow; choose another --run")
    prepared = _prepare(args)
    with user_errors(OSError, prefix=f"{args.run} cannot be written: "):
        args.run.mkdir(parents=True, exist_ok=True)
    with user_errors(RunDirectoryError):
        lock = lock_directory(args.run)
    with lock, StopSignals(hint=HINT) as stop:
        try:
            return _clone(args, prepared, stop)
        except StopRequested:
            say(f"kinetix-dist: stopped by {stop.requested}{HINT}", sys.stderr)
            return EXIT_STOPPED


class _Prepared(NamedTuple):
    demonstrations: Demonstrations
    config: FlowConfig
    env: Environment
    policy: ChunkPolicy
    samples: Samples


def _prepare(args: Args) -> _Prepared:
    """Samples and network. Raises UserError before anything is written."""
    from kinetix_dist.data import DatasetError
    from kinetix_dist.delay.chunk_policy import make_chunk_policy
    from kinetix_dist.delay.cloning import split_episodes
    from kinetix_dist.delay.demonstrations import open_demonstrations, samples_of
    from kinetix_dist.env.environment import Environment

    with user_errors(DatasetError, ValueError, OSError):
        demonstrations = open_demonstrations(args.data, skip_damaged=args.skip_damaged)
        for data in demonstrations.datasets:
            if data.shortfall:
                say(data.shortfall, sys.stderr)
        config = _for_observation(args.flow, demonstrations.env_config.observation)
        env = Environment(demonstrations.env_config)
        policy = make_chunk_policy(config, env)
        samples = samples_of(demonstrations, policy, solved_only=args.solved_only)
        split_episodes(samples.left, args.training.held_out, args.training.seed)
    return _Prepared(demonstrations, config, env, policy, samples)


def _clone(args: Args, prepared: _Prepared, stop: StopSignals) -> int:
    from kinetix_dist.delay import cloning_state
    from kinetix_dist.delay.cloning import clone, untrained
    from kinetix_dist.models.policy import num_parameters

    demonstrations, config, env, policy, samples = prepared
    skipped = sum(len(each.skipped) for each in demonstrations.datasets)
    cloning_state.claim(args.run, cloning_state.design_of(config, args.training, demonstrations, len(samples.level)))
    print(
        f"{len(samples.level):,} transitions of {len(samples.bound)} levels, chunks of {config.horizon} actions"
        + (f"; {skipped} shards are damaged or missing and left out" if skipped else ""),
        flush=True,
    )
    fresh = untrained(policy, env, samples, args.training)
    begun, passed_over = cloning_state.newest_state(args.run, fresh)
    for line in passed_over:
        print(line, flush=True)
    if begun.steps > args.training.steps:
        raise UserError(f"{args.run} has {begun.steps:,} steps already; give --steps {begun.steps} or more")
    if begun.steps:
        print(f"goes on after step {begun.steps:,} of {args.training.steps:,}", flush=True)
    cloning_state.cut_progress(args.run, begun.steps)
    report = _Report(args, config, demonstrations, begun.steps, stop)
    print(f"losses come every {args.training.report_every:,} steps, the first also after compiling", flush=True)
    with user_errors(ValueError, OSError, CheckpointError), stop.deferred():
        params = clone(policy, env, samples, args.training, max_delay=config.max_delay, begun=begun, on_report=report)
    print(f"{num_parameters(params):,} parameters in {cloning_state.newest_policy(args.run)}")
    print(f"play it   kinetix-dist bench delay --policy {args.run} --levels SET --picture {args.run / 'delay.png'}")
    return 0


class _Report:
    """Prints and stores losses, writes checkpoints and states, and ends where a stop is requested."""

    def __init__(
        self, args: Args, config: FlowConfig, demonstrations: Demonstrations, begun: int, stop: StopSignals
    ) -> None:
        """begun: steps done before."""
        self._args, self._config, self._data, self._stop = args, config, demonstrations, stop
        self._began = self._saved_at = time.monotonic()
        self._saved = NUM_CHECKPOINTS * begun // args.training.steps  # quarters

    def __call__(self, progress: Progress) -> None:
        from kinetix_dist.delay.chunk_policy import save_chunk_policy
        from kinetix_dist.delay.cloning_state import CHECKPOINTS, PROGRESS_NAME, save_state
        from kinetix_dist.telemetry.json_lines import append_line

        args, steps, now = self._args, self._args.training.steps, time.monotonic()
        losses = {"loss": progress.loss, "held_out_loss": progress.held_out_loss}
        seconds = {"seconds": round(now - self._began, 1)}  # of this command
        append_line(args.run / PROGRESS_NAME, {"step": progress.steps} | seconds | losses)
        print(
            f"step {progress.steps:,} of {steps:,}  {now - self._began:.0f} s  loss {progress.loss:.4f}  "
            f"held out {progress.held_out_loss:.4f}",
            flush=True,
        )
        if (quarters := NUM_CHECKPOINTS * progress.steps // steps) > self._saved:
            self._saved = quarters
            training = dataclasses.asdict(args.training)
            notes = losses | {"data": self._data.description, "training": training}
            save_chunk_policy(
                args.run / CHECKPOINTS,
                progress.steps,
                progress.params,
                self._config,
                self._data.env_config,
                notes=notes,
            )
        is_stopped, is_last = self._stop.requested is not None, progress.steps == steps
        if is_stopped or is_last or now - self._saved_at >= args.save_seconds:
            save_state(args.run, progress.learned)
            self._saved_at = time.monotonic()
        if not is_last:
            self._stop.raise_if_requested()


def _for_observation(config: FlowConfig, observation: str) -> FlowConfig:
    """The network that reads what the data hold, where none was chosen."""
    if observation not in NETWORKS or config.encoder.network != FlowConfig().encoder.network:
        return config
    return dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, network=NETWORKS[observation]))
