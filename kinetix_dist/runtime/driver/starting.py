"""What a new run starts from: its seed, or a policy that exists (`run.start_from`, `train --from`).

Parameters are taken, and the state of the optimiser where that is asked for; counters, curriculum and random streams
are those of a new run. Where it came from stays with it: every checkpoint of the run describes its lineage.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import Checkpoint, CheckpointError, flatten_arrays, load_checkpoint, select_arrays
from kinetix_dist.config import TrainConfig, differing, from_dict_for_playing
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX, load_policy
from kinetix_dist.models.policy import NETWORKS
from kinetix_dist.runtime.cores.stored import LEARNER, OPTIMIZER, PARAMS, START, one_level

# Of `policy`: parameters have the same shapes whatever these are, or are added (models/added_layers.py).
_FUNCTION = ("network", "num_heads", "max_qk_norm", "num_layers")
LINEAGE = "lineage"  # in the description of a checkpoint: where it comes from, the oldest first
# Of a checkpoint's description, what its children keep of it.
_KEPT = ("config_hash", "num_updates", "env_steps", "training_seconds")


@dataclasses.dataclass(frozen=True)
class Start:
    """What a new run takes of an earlier one."""

    arrays: dict[str, np.ndarray] | None = None  # for `Trainer.start` at update 0; None: all from the seed
    lineage: tuple[Mapping[str, Any], ...] = ()
    differs: tuple[str, ...] = ()  # fields of `policy` by which the same parameters compute something else, in words


def starting_point(config: TrainConfig) -> Start:
    """Raises CheckpointError, one line, where there is no such checkpoint, where it is of another network (but for
    layers that this run has more of) or of other settings of the engine, or where it holds no optimiser, or one of
    fewer layers, and that is asked for."""
    if not config.run.start_from:
        return Start()
    path = Path(config.run.start_from)
    if (path / "checkpoints").is_dir():
        raise CheckpointError(f"run.start_from: {path} is a run; name one of the directories in {path}/checkpoints")
    checkpoint = load_checkpoint(path)
    if not config.run.start_other_engine:
        _check_engine(checkpoint, config.env)
    ours, theirs = config.policy, from_dict_for_playing(checkpoint.description["config"]).policy
    have_layers = NETWORKS[ours.network].has_attention and NETWORKS[theirs.network].has_attention
    is_deeper = have_layers and ours.num_layers > theirs.num_layers
    if have_layers and ours.num_layers < theirs.num_layers:
        raise CheckpointError(
            f"run.start_from: {checkpoint.path} has {theirs.num_layers} layers and policy.num_layers is "
            f"{ours.num_layers}; set it to {theirs.num_layers}, or to more: layers can be added and not left out"
        )
    optimizer = select_arrays(checkpoint.arrays, f"{LEARNER}/{OPTIMIZER}")
    if config.run.start_optimizer and not optimizer:
        raise CheckpointError(
            f"run.start_optimizer: {checkpoint.path} holds the parameters of a policy and no optimiser; name a "
            "checkpoint of a run, or leave it out"
        )
    if config.run.start_optimizer and is_deeper:
        raise CheckpointError(
            f"run.start_optimizer: policy.num_layers is {ours.num_layers} and the optimiser of {checkpoint.path} is of "
            f"{theirs.num_layers}; leave it out where layers are added"
        )
    env = Environment(config.env)  # for shapes
    # The learner adds layers that are missing: it has parameters as they are initialised.
    policy = dataclasses.replace(ours, num_layers=theirs.num_layers) if is_deeper else ours
    try:
        _, params = load_policy(checkpoint, policy, env, one_level(config))
    except ValueError as error:
        raise CheckpointError(
            f"run.start_from: {checkpoint.path} does not fit policy.*, env.observation and env.action_space of this "
            f"run: {error}"
        ) from error
    differs = differing(*({f"policy.{name}": getattr(policy, name) for name in _FUNCTION} for policy in (ours, theirs)))
    arrays = flatten_arrays({PARAMS: params})
    if config.run.start_optimizer:
        # Moments belong to the parameters that learned, not to their average.
        arrays = flatten_arrays({PARAMS: select_arrays(checkpoint.arrays, PARAMS_PREFIX), OPTIMIZER: optimizer})
    arrays = {f"{START}/{name}": array for name, array in arrays.items()}
    return Start(arrays, lineage_from(checkpoint), tuple(differs))


def lineage_from(checkpoint: Checkpoint) -> tuple[Mapping[str, Any], ...]:
    """Of what starts from this checkpoint: its own ancestors, then itself."""
    description = checkpoint.description
    itself = {"checkpoint": str(checkpoint.path), "recipe": description["config"]["run"]["name"]}
    itself |= {name: description[name] for name in _KEPT if name in description}
    return (*description.get(LINEAGE, ()), itself)


def _check_engine(checkpoint: Checkpoint, env: EnvConfig) -> None:
    theirs = from_dict_for_playing(checkpoint.description["config"]).env
    ours = {"frame_skip": env.frame_skip} | dataclasses.asdict(env.physics)
    learned = {"frame_skip": theirs.frame_skip} | dataclasses.asdict(theirs.physics)
    if differs := [f"{name} {learned[name]} instead of {ours[name]}" for name in ours if ours[name] != learned[name]]:
        raise CheckpointError(
            f"run.start_from: {checkpoint.path} learned with other settings of the engine: {', '.join(differs)}; set "
            "env.frame_skip and env.physics.* to these, or --run.start_other_engine True to learn anew with yours"
        )
