"""Policies of checkpoints with the config that they were trained with: of a run, of a directory, pretrained ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from kinetix_dist.checkpoint import Checkpoint, CheckpointError, Rejected, load_checkpoint, newest_good
from kinetix_dist.checkpoint.manifest import MANIFEST_NAME
from kinetix_dist.checkpoint.store import DESCRIPTION_NAME
from kinetix_dist.config import StoredConfig, from_dict_for_playing
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.load_policy import load_policy
from kinetix_dist.evaluation.policies import NetworkPolicy, Player
from kinetix_dist.level.level import Level

DESIGN_NAME = "design.json"  # of directories of specialists, sweeps and studies
CHUNK_POLICY = "chunk_policy"  # in the description of a checkpoint that kinetix_dist/delay/ plays
MAX_LISTINGS = 3  # of a run's checkpoints, where all that were listed are pruned while they are read


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trained:
    """Verified checkpoint with the settings by which its policy plays."""

    checkpoint: Checkpoint
    config: StoredConfig

    @property
    def num_updates(self) -> int:
        return self.checkpoint.description["num_updates"]

    def env_config(self, size: str) -> EnvConfig:
        return env_config_of(self.config, size)

    def player(self, env: Environment, levels: Level, *, greedy: bool = False) -> Player:
        """Player of levels [W, ...] like these. Raises UserError where the policy does not fit levels of this size."""
        path, size = self.checkpoint.path, env.config.size
        with user_errors(ValueError, prefix=f"checkpoint {path} does not fit levels of size {size}: "):
            module, params = load_policy(self.checkpoint, self.config.policy, env, levels)
        return Player(NetworkPolicy(module, env.action_distribution, greedy=greedy), params)


def env_config_of(config: StoredConfig, size: str) -> EnvConfig:
    """Environment of a run for levels of a size."""
    return dataclasses.replace(config.env, size=size)


def trained_at(path: Path) -> Trained:
    """Newest checkpoint of a run, or the checkpoint of a directory or of a pretrained policy's name. Raises
    UserError."""
    return newest_checkpoint_of(path)[0] if (path / "checkpoints").is_dir() else checkpoint_at(path)


def checkpoint_at(path: Path) -> Trained:
    """Checkpoint of a directory, or of a pretrained policy by its name. Raises UserError."""
    if (path / "checkpoints").is_dir():
        raise UserError(f"{path} is a run directory; give it as a run")
    if (path / DESIGN_NAME).is_file():
        raise UserError(f"{path} holds results of several policies ({DESIGN_NAME}); name the directory of one of them")
    if path.is_dir() and not (path / MANIFEST_NAME).exists() and not (path / DESCRIPTION_NAME).exists():
        raise UserError(f"{path} is no run, checkpoint or directory of specialists; give one of these")
    with user_errors(CheckpointError, ValueError, OSError):
        return _trained(load_checkpoint(path))


def newest_checkpoint_of(run: Path) -> tuple[Trained, list[Rejected]]:
    """Newest checkpoint of a run that can be read, and newer ones that cannot. Raises UserError where there is none."""
    if not run.is_dir():
        raise UserError(f"{run} is not a directory; give a run directory such as runs/quickstart")
    rejected: list[Rejected] = []
    for _ in range(MAX_LISTINGS):
        newest, rejected = newest_good(run / "checkpoints")
        if newest is not None:
            return _trained(newest), rejected
        if not any(not bad.path.exists() for bad in rejected):
            break  # none was pruned while it was read: listing them again would find the same
    raise UserError(f"{run} has no checkpoint that can be used; train it further, or give another checkpoint")


def _trained(checkpoint: Checkpoint) -> Trained:
    if CHUNK_POLICY in checkpoint.description:
        raise UserError(f"{checkpoint.path} is a policy of action chunks; `kinetix-dist bench delay --policy` plays it")
    with user_errors(CheckpointError):
        stored = checkpoint.config
    with user_errors(ValueError, prefix=f"checkpoint {checkpoint.path}: "):
        return Trained(checkpoint=checkpoint, config=from_dict_for_playing(stored))
