"""From `policy` and `env` of a request to who plays in which environment."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jax2d.scene import stack_worlds
from jax2d.settings import preset
from kinetix_dist.config import from_dict_for_playing
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.errors import one_line, user_errors
from kinetix_dist.evaluation.policies import NoopPolicy, Player, RandomPolicy
from kinetix_dist.level.level import Level
from kinetix_dist.studio.worker import programs
from kinetix_dist.studio.worker.session import PERSON_SPACE, Actor
from kinetix_dist.studio.worker.wire import BAD_REQUEST, NOT_FOUND, RequestError
from kinetix_dist.text_files import read_json
from kinetix_dist.trained_policy import Trained, checkpoint_at, env_config_of, newest_checkpoint_of

KEYS, RANDOM, NOOP = "keys", "random", "noop"
# Of a request, besides "run": numbers by their types, and a preset of the solver.
NUMBERS = {
    "frame_skip": int,
    "max_steps": int,
    "dense_reward_scale": (int, float),
    "failure_penalty": (int, float),
}
ENV_FIELDS = (*NUMBERS, "preset")


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenPolicy:
    """The `policy` of a request, its checkpoint read."""

    kind: str  # KEYS, RANDOM, NOOP or "checkpoint"
    trained: Trained | None = None
    passed_over: tuple[str, ...] = ()  # newer checkpoints that could not be read, one line each

    def actor(self, env_config: EnvConfig, level: Level) -> Actor:
        """Raises UserError where the policy does not fit levels of this size."""
        if self.trained is None:
            config = dataclasses.replace(env_config, action_space=PERSON_SPACE.name)
            env = programs.environment(config)
            policies = {RANDOM: RandomPolicy(env.action_space), NOOP: NoopPolicy(env.action_space)}
            player = Player(policies[self.kind]) if self.kind in policies else None
            return Actor(env=env, player=player, about={"kind": self.kind})
        own = self.trained.config.env
        config = dataclasses.replace(env_config, observation=own.observation, action_space=own.action_space)
        env = programs.environment(config)
        player = self.trained.player(env, stack_worlds([level]))
        about = {
            "kind": self.kind,
            "path": str(self.trained.checkpoint.path),
            "num_updates": self.trained.num_updates,
            "heads": programs.heads_of(player.policy) | {"controls": programs.controls_of_outputs(env.action_space)},
            "passed_over": list(self.passed_over),
        }
        return Actor(env=env, player=player, about=about)


def policy_of(given: Any) -> GivenPolicy:
    """Raises RequestError or UserError."""
    if given in (KEYS, RANDOM, NOOP):
        return GivenPolicy(kind=given)
    if isinstance(given, Mapping) and len(given) == 1:
        ((name, value),) = given.items()
        if name == "checkpoint" and isinstance(value, str) and value:
            return GivenPolicy(kind="checkpoint", trained=checkpoint_at(Path(value)))
        if name == "run" and isinstance(value, str) and Path(value).is_absolute():
            trained, rejected = newest_checkpoint_of(Path(value))
            passed_over = tuple(f"{bad.path.name}: {one_line(bad.reason)}" for bad in rejected)
            return GivenPolicy(kind="checkpoint", trained=trained, passed_over=passed_over)
    raise RequestError(
        BAD_REQUEST,
        f'policy is {repr(given)[:60]}; give "{KEYS}", "{RANDOM}", "{NOOP}", {{"run": PATH}} or {{"checkpoint": PATH}}',
    )


def env_of(given: Any, size: str, trained: Trained | None = None) -> EnvConfig:
    """The environment for levels of a size: of `env` of a request, else of the policy, else the defaults.

    Raises RequestError or UserError.
    """
    if given is None:
        given = {}
    if not isinstance(given, Mapping):
        raise RequestError(BAD_REQUEST, f"env is {repr(given)[:60]}; give an object, or leave it out")
    if unknown := sorted(set(given) - {"run", *ENV_FIELDS}):
        raise RequestError(BAD_REQUEST, f"env has {unknown[0]!r}; fields are run, {', '.join(ENV_FIELDS)}")
    if "run" in given:
        base = _env_of_run(given["run"], size)
    else:
        base = trained.env_config(size) if trained is not None else EnvConfig(size=size)
    changes = {name: given[name] for name in ENV_FIELDS if name in given}
    with user_errors(ValueError, TypeError, prefix="env: "):
        if "preset" in changes:
            changes["physics"] = preset(changes.pop("preset"))
        for name, kind in NUMBERS.items():
            if name in changes and (not isinstance(changes[name], kind) or isinstance(changes[name], bool)):
                raise ValueError(f"{name} is {changes[name]!r}; give a number")
        return dataclasses.replace(base, **changes)


def _env_of_run(given: Any, size: str) -> EnvConfig:
    if not isinstance(given, str) or not Path(given).is_absolute():
        raise RequestError(BAD_REQUEST, f"env.run is {given!r}; give an absolute path")
    path = Path(given) / "config.json"
    try:
        data = read_json(path)
    except OSError as error:
        raise RequestError(NOT_FOUND, f"{path} cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise RequestError(BAD_REQUEST, f"{path} is not JSON ({one_line(error)})") from error
    if not isinstance(data, dict) or not isinstance(data.get("config"), dict):
        raise RequestError(BAD_REQUEST, f"{path} is of no run: it has no object `config`")
    with user_errors(ValueError, AttributeError, prefix=f"{path}: "):
        return env_config_of(from_dict_for_playing(data["config"]), size)
