"""Starting points of specialists: the seed, or the parameters of a policy that exists."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

from kinetix_dist.checkpoint.manifest import MANIFEST_NAME
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import UserError
from kinetix_dist.trained_policy import Trained, checkpoint_at, newest_checkpoint_of

FROM_SCRATCH = "scratch"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Start:
    """One of the two, or several, that a comparison has."""

    name: str  # of a directory and of a line in pictures
    checkpoint: str = ""  # path, for `run.start_from`; "": the seed
    description: dict[str, Any] | None = None  # of the checkpoint, for lineage; None: the seed

    @property
    def label(self) -> str:
        """Name for a person."""
        return "from scratch" if self.description is None else f"from {self.name}"


SCRATCH = Start(name=FROM_SCRATCH)


def policy_at(path: Path) -> Trained:
    """The checkpoint at a path, the newest good one of a run, or a pretrained policy by name. Raises UserError."""
    if (path / "checkpoints").is_dir():
        return newest_checkpoint_of(path)[0]
    return checkpoint_at(path)


def start_from(trained: Trained) -> Start:
    """The start that a checkpoint is: `runs/quickstart/checkpoints/00000104` is called quickstart-104."""
    checkpoint = trained.checkpoint
    path = checkpoint.path.resolve()
    is_of_run = path.parent.name == "checkpoints" and path.name.isdecimal()
    name = f"{path.parent.parent.name}-{int(path.name)}" if is_of_run else path.name
    if not name:
        raise UserError(f"{path} has no name for results; give a checkpoint in a directory of its own")
    if name == FROM_SCRATCH:
        raise UserError(f"{path} is called {name!r} like a start from the seed; rename the directory")
    description = checkpoint.description
    return Start(
        name=name,
        checkpoint=str(path),
        description={
            "checkpoint": str(path),
            "sha256": hashlib.sha256((path / MANIFEST_NAME).read_bytes()).hexdigest(),  # of the sums of all its files
            "policy_updates": description["num_updates"],
            "env_steps": description.get("env_steps"),
            "config_hash": description.get("config_hash"),
            "start_from": trained.config.run.start_from,  # what that policy was trained from in its turn
        },
    )


def like_policy(config: TrainConfig, trained: Trained) -> TrainConfig:
    """`config` with the network and the environment of a policy, and the modules that its parts come from."""
    theirs = trained.config
    plugins = tuple(dict.fromkeys((*config.run.plugins, *theirs.run.plugins)))
    return dataclasses.replace(
        config, env=theirs.env, policy=theirs.policy, run=dataclasses.replace(config.run, plugins=plugins)
    )
