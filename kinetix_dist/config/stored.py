"""Configurations that were stored, in config.json of a run or in a checkpoint: read with today's names of settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.config.plain import build, flat, to_dict
from kinetix_dist.config.train_config import StoredConfig, TrainConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.registry import import_plugins, import_stored_plugins
from kinetix_dist.renamed_settings import RenamedSettingError, translated
from kinetix_dist.setting import ConfigError


def from_dict(data: Mapping[str, Any]) -> TrainConfig:
    """Return the configuration whose `to_dict` is `data`, after importing its plugins.

    Only for words of the user: options, designs, and a run that the user resumes. `from_dict_for_playing` and
    `from_dict_as_recipe` read configurations of other people.

    Raises:
        ConfigError: A field is unknown or of another type, or a setting that is gone was in use.
        PluginError: A plugin cannot be imported.
    """
    import_plugins(_plugins_of(data))
    return build(TrainConfig, _with_todays_names(data, for_playing=False))


def from_dict_as_recipe(data: Mapping[str, Any]) -> TrainConfig:
    """Return the configuration of another run, for a new one: its plugins need trust, its compile cache is not used.

    Raises ConfigError as `from_dict` does and for a name that leads out of runs/, and PluginError for plugins that the
    user does not trust.
    """
    import_stored_plugins(_plugins_of(data))
    config = from_dict(data)
    if (name := config.run.name) in ("", ".", "..") or "/" in name or "\\" in name:
        raise ConfigError(f"config field run.name is {name[:60]!r}; a name without folders is needed in a recipe")
    return dataclasses.replace(config, run=dataclasses.replace(config.run, compile_cache=""))


def from_dict_for_playing(data: Mapping[str, Any]) -> StoredConfig:
    """Return the settings by which a policy plays, on any device; no other section of `data` is read.

    Raises ConfigError as `from_dict` does, and PluginError for plugins that the user does not trust.
    """
    data = _with_todays_names(data, for_playing=True)
    policy = data.get("policy")
    plugins = import_stored_plugins(_plugins_of(data))
    if isinstance(policy, dict) and policy.get("kernels") == "fused":  # of Hopper GPUs, and of some networks
        policy["kernels"] = "auto"
    sections = {name: data[name] for name in ("env", "policy") if name in data}
    return build(StoredConfig, {**sections, "plugins": plugins})


def curriculum_from_dict(data: Mapping[str, Any]) -> CurriculumConfig:
    """Return the curriculum of a configuration that `from_dict_for_playing` has read, without its path of levels."""
    section = _with_todays_names(data, for_playing=True).get("curriculum", {})
    return dataclasses.replace(build(CurriculumConfig, section, "curriculum"), levels="")


def has_same_numbers(config: TrainConfig, stored: Mapping[str, Any], stored_hash: str) -> bool:
    """Return whether training continues with `config` as with a stored one: their hashes are equal, at once or after
    settings are renamed. A setting that the stored one lacks makes it another version, whatever its value is."""
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


def _plugins_of(data: Mapping[str, Any]) -> Sequence[str]:
    """Return `run.plugins`; raise ConfigError for anything but a list of names."""
    run = data.get("run", {}) if isinstance(data, Mapping) else data
    plugins = run.get("plugins", ()) if isinstance(run, Mapping) else run
    if not isinstance(plugins, list | tuple) or not all(isinstance(name, str) for name in plugins):
        raise ConfigError(f"config field run.plugins is {str(plugins)[:60]!r}; a list of names in an object is needed")
    return plugins


def _with_todays_names(data: Mapping[str, Any], *, for_playing: bool) -> dict[str, Any]:
    if not isinstance(data, Mapping):
        raise ConfigError(f"a configuration is {str(data)[:60]!r}; an object is needed")
    try:
        return translated(data, for_playing=for_playing)
    except RenamedSettingError as error:
        raise ConfigError(f"this config is of an older version: {error}") from error
    except ValueError as error:
        raise ConfigError(str(error)) from error
