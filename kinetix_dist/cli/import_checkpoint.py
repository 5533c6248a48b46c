"""`kinetix-dist import-checkpoint`: a policy of the public Kinetix package as a checkpoint of ours.

    kinetix-dist import-checkpoint checkpoints/sfl-1m-envs --out pretrained/sfl-1m-envs
    kinetix-dist eval --checkpoint pretrained/sfl-1m-envs --levels designed_m
    kinetix-dist train --recipe sfl_m --from pretrained/sfl-1m-envs --policy.network transformer_kinetix \\
        --policy.dtype float32 --env.observation entity_kinetix

Reads what the package's `save_pretrained_checkpoint` writes: params.safetensors and config.json in one directory.
Pickles (model.pbz2) are refused: reading one could run anything.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.text_files import read_json

if TYPE_CHECKING:
    from kinetix_dist.config import TrainConfig
    from kinetix_dist.models.policy import PolicyConfig

PARAMS_NAME, CONFIG_NAME = "params.safetensors", "config.json"
# What `PolicyConfig` cannot express, and what imported policies have of it.
_FIXED = {
    "activation": "tanh",
    "aggregate_mode": "dummy_and_mean",
    "full_attention_mask": False,
    "transformer_ffn": False,
    "multilayer_joint_thruster_mixing": False,
    "permutation_invariant_mlp": False,
    "recurrent_model": False,
}
_SIZES = {  # option of the package: field of PolicyConfig
    "transformer_encoder_size": "encoder_size",
    "transformer_size": "attention_features",
    "num_heads": "num_heads",
    "transformer_depth": "num_layers",
    "actor_width": "hidden_size",
    "critic_width": "hidden_size",
    "actor_depth": "hidden_layers",
    "critic_depth": "hidden_layers",
}
_LEGACY = "legacy_entity_id"


@dataclasses.dataclass
class Args:
    """A policy of the public Kinetix package as a checkpoint that eval, replay and train take."""

    source: Annotated[Path, tyro.conf.Positional]
    """Its folder, with params.safetensors and config.json, or the .safetensors file."""
    out: Path
    """The new checkpoint, a directory."""
    legacy_entity_id: bool | None = None
    """All shapes have the number 0, as in the paper's policy; default: what config.json says."""


def run(args: Args) -> int:
    file = args.source / PARAMS_NAME if args.source.is_dir() else args.source
    if not file.is_file():
        raise UserError(f"there is no {file}; give the folder or the .safetensors file of a policy of the package")
    if args.out.exists():
        raise UserError(f"{args.out} exists; choose another --out")
    if not args.out.parent.is_dir():
        raise UserError(f"{args.out.parent} is not a directory; choose another --out")
    from kinetix_dist.checkpoint import CheckpointError, flatten_arrays, save_alone
    from kinetix_dist.checkpoint.arrays import SafetensorsError, read_safetensors
    from kinetix_dist.config import to_dict
    from kinetix_dist.env.action_spaces import ACTION_SPACES
    from kinetix_dist.env.observations.kinetix_entities import NUM_FEATURES
    from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX
    from kinetix_dist.models.kinetix_parameters import FeatureCounts, ParameterTreeError, from_package
    from kinetix_dist.models.policy import num_parameters

    with user_errors(SafetensorsError, OSError):
        arrays = read_safetensors(file)
    policy = _policy_config(file.parent / CONFIG_NAME, args.legacy_entity_id)
    config = _train_config(policy)
    distribution = ACTION_SPACES[config.env.action_space].distribution
    assert distribution is not None
    with user_errors(ParameterTreeError, prefix=f"{file}: "):
        params = from_package(arrays, policy, FeatureCounts(**NUM_FEATURES), distribution.head_sizes)
    description = {
        "config": to_dict(config),
        "config_hash": config.hash,
        "env_steps": 0,
        "training_seconds": 0.0,
        "imported_from": file.name,
    }
    with user_errors(CheckpointError, OSError):
        save_alone(args.out, 0, flatten_arrays(_below(PARAMS_PREFIX, params)), description)
    print(f"imported  {num_parameters(params):,} parameters, network {policy.network}, into {args.out}")
    print(f"play      kinetix-dist eval --checkpoint {args.out} --levels designed_m")
    options = f"--policy.network {policy.network} --policy.dtype float32 --env.observation {config.env.observation}"
    print(f"train on  kinetix-dist train --recipe sfl_m --from {args.out} {options}")
    return 0


def _policy_config(path: Path, legacy_entity_id: bool | None) -> PolicyConfig:
    """Network by the options in config.json; missing ones are the paper's. The tree itself shows wrong sizes."""
    from kinetix_dist.models.policy import PolicyConfig

    model = _model_options(path)
    for name, wanted in _FIXED.items():
        if name in model and model[name] != wanted:
            raise UserError(f"{path}: {name} is {model[name]!r}; only policies with {wanted!r} can be imported")
    sizes: dict[str, Any] = {}  # of JSON: checked by PolicyConfig
    for name, field in _SIZES.items():
        if name in model and sizes.setdefault(field, model[name]) != model[name]:
            raise UserError(f"{path}: {name} is {model[name]!r}, but actor and critic of one size can be imported only")
    legacy = model.get(_LEGACY) if legacy_entity_id is None else legacy_entity_id
    if legacy is None:
        raise UserError(
            f"{path} does not say {_LEGACY}; give --legacy-entity-id for the paper's policy, else --no-legacy-entity-id"
        )
    network = "transformer_kinetix_paper" if legacy else "transformer_kinetix"
    with user_errors(ValueError, TypeError, prefix=f"{path}: "):
        return PolicyConfig(network=network, **sizes)


def _model_options(path: Path) -> dict[str, Any]:
    """Options of the network in config.json; none where there is no such file."""
    if not path.is_file():
        return {}
    with user_errors(ValueError, OSError, prefix=f"{path}: "):
        content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("model"), dict):
        raise UserError(f"{path} has no options of a network under 'model'")
    return content["model"]


def _train_config(policy: PolicyConfig) -> TrainConfig:
    """A configuration with which the policy plays and can be trained on: that of sfl_m but for what it sees and is."""
    from kinetix_dist.recipes import recipe

    base = recipe("sfl_m")
    return dataclasses.replace(
        base,
        env=dataclasses.replace(base.env, observation="entity_kinetix"),
        policy=policy,
        run=dataclasses.replace(base.run, name="imported"),
    )


def _below(prefix: str, tree: Any) -> dict[str, Any]:
    for name in reversed(prefix.split("/")):
        tree = {name: tree}
    return tree
