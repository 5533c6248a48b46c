"""Configurations that were stored, in config.json of a run or in a checkpoint: read with today's names of settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.config.plain import build, flat, to_dict
from kinetix_dist.config.train_config import StoredConfig, TrainConfig
from kinetix_dist.registry import import_plugins
from kinetix_dist.renamed_settings import RenamedSettingError, translated
from kinetix_dist.setting import ConfigError

Config = TypeVar("Config", bound=TrainConfig)


def from_dict(data: Mapping[str, Any]) -> TrainConfig:
    """The inverse of `to_dict`. Raises ConfigError for a field that is unknown or of another type, and for a setting
    that is gone and was in use."""
    return _read(TrainConfig, data, for_playing=False)


def from_dict_for_playing(data: Mapping[str, Any]) -> StoredConfig:
    """Configuration of a policy that is only played, on any device: checks of training are left out."""
    data = _with_todays_names(data, for_playing=True)
    policy = data.get("policy")
    if isinstance(policy, dict) and policy.get("kernels") == "fused":  # of Hopper GPUs, and of some networks
        policy["kernels"] = "auto"
    return _read(StoredConfig, data, for_playing=True)


def has_same_numbers(config: TrainConfig, stored: Mapping[str, Any], stored_hash: str) -> bool:
    """Training goes on with `config` as with a stored one: they have the same hash, at once or with today's names of
    settings. A setting that the stored one lacks makes it another version, whatever its value is now."""
    if stored_hash == config.hash:
        return True
    try:
        theirs, names = from_dict(stored), flat(_with_todays_names(stored, for_playing=False)).keys()
    except ValueError:
        return False
    return flat(to_dict(theirs)).keys() == names and theirs.hash == config.hash


def with_phases(config: TrainConfig, phases: Sequence[Mapping[str, Any]]) -> TrainConfig:
    """The config with these phases, given as plain values, in place of its own. Raises ValueError, one line."""
    built = tuple(build(PhaseConfig, phase, f"phases.{number}") for number, phase in enumerate(phases))
    return dataclasses.replace(config, phases=built)


def _read(kind: type[Config], data: Mapping[str, Any], *, for_playing: bool) -> Config:
    import_plugins(data.get("run", {}).get("plugins", ()))
    return build(kind, _with_todays_names(data, for_playing=for_playing))


def _with_todays_names(data: Mapping[str, Any], *, for_playing: bool) -> dict[str, Any]:
    try:
        return translated(data, for_playing=for_playing)
    except RenamedSettingError as error:
        raise ConfigError(f"this config is of an older version: {error}") from error
