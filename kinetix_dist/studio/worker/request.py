"""Requests: checked fields, progress, cancelling; and who plays in which environment, by `policy` and `env`."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jax2d.scene import stack_worlds
from jax2d.settings import preset
from kinetix_dist.config import from_dict_for_playing
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.errors import one_line, user_errors
from kinetix_dist.evaluation.policies import NoopPolicy, Player, RandomPolicy
from kinetix_dist.level.level import Level
from kinetix_dist.studio.worker import programs
from kinetix_dist.studio.worker.run_config import config_of_run
from kinetix_dist.studio.worker.session import PERSON_SPACE, Actor
from kinetix_dist.studio.worker.wire import BAD_REQUEST, CANCELLED, Outbox, RequestError
from kinetix_dist.trained_policy import Trained, checkpoint_at, env_config_of, newest_checkpoint_of

_REQUIRED = object()


class Request:
    """Request of a client. Methods that read `fields` raise RequestError with the name of the field."""

    def __init__(self, fields: dict[str, Any], outbox: Outbox) -> None:
        self.fields, self._outbox = fields, outbox
        self.id: int = fields["id"]
        self._is_cancelled = threading.Event()

    def cancel(self) -> None:
        self._is_cancelled.set()

    def check_cancelled(self) -> None:
        """Raises RequestError where the client has cancelled the request."""
        if self._is_cancelled.is_set():
            raise RequestError(CANCELLED, "cancelled")

    def progress(self, stage: str, **facts: Any) -> None:
        """Sends how far it is. Raises RequestError where it was cancelled."""
        self.check_cancelled()
        self._outbox.send({"type": "progress", "id": self.id, "stage": stage, **facts})

    def number(self, name: str, *, low: int, high: int, default: Any = _REQUIRED) -> int:
        value = self.fields.get(name, default)
        if type(value) is not int or not low <= value <= high:
            raise self._wrong(name, value, f"give a whole number from {low} to {high}")
        return value

    def real(self, name: str, *, low: float, high: float) -> float:
        value = self.fields.get(name)
        if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
            raise self._wrong(name, value, f"give a number from {low:g} to {high:g}")
        return float(value)

    def flag(self, name: str, *, default: bool) -> bool:
        value = self.fields.get(name, default)
        if not isinstance(value, bool):
            raise self._wrong(name, value, "give true or false")
        return value

    def choice(self, name: str, known: Any, default: Any = _REQUIRED) -> str:
        value = self.fields.get(name, default)
        if not isinstance(value, str) or value not in known:
            raise self._wrong(name, value, f"give one of {', '.join(known)}")
        return value

    def path(self, name: str) -> Path:
        value = self.fields.get(name)
        if not isinstance(value, str) or not Path(value).is_absolute():
            raise self._wrong(name, value, "give an absolute path")
        return Path(value)

    def _wrong(self, name: str, value: Any, advice: str) -> RequestError:
        if value is _REQUIRED or name not in self.fields:
            return RequestError(BAD_REQUEST, f"{self.fields['type']}: {name} is missing; {advice}")
        text = repr(value)
        return RequestError(BAD_REQUEST, f"{self.fields['type']}: {name} is {text[:60]}; {advice}")


KEYS, RANDOM, NOOP, ACTIONS = "keys", "random", "noop", "actions"
MAX_ACTIONS = 100_000  # steps
# Fields of `env` besides "run": numbers by their types, the name of a reward, and a preset of the solver.
NUMBERS = {
    "frame_skip": int,
    "max_steps": int,
    "dense_reward_scale": (int, float),
    "failure_penalty": (int, float),
}
ENV_FIELDS = (*NUMBERS, "reward", "preset")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RequestedPolicy:
    """Policy of a request, its checkpoint read."""

    kind: str  # KEYS, RANDOM, NOOP, ACTIONS or "checkpoint"
    trained: Trained | None = None
    actions: np.ndarray | None = None  # [T, 6] of ACTIONS
    skipped: tuple[str, ...] = ()  # newer checkpoints that could not be read, one line each

    def actor(self, env_config: EnvConfig, level: Level) -> Actor:
        """Actor that plays a level. Raises UserError where the policy does not fit levels of this size."""
        if self.trained is None:
            config = dataclasses.replace(env_config, action_space=PERSON_SPACE.name)
            env = programs.environment(config)
            policies = {RANDOM: RandomPolicy(env.action_space), NOOP: NoopPolicy(env.action_space)}
            player = Player(policies[self.kind]) if self.kind in policies else None
            return Actor(env=env, player=player, about={"kind": self.kind}, actions=self.actions)
        own = self.trained.config.env
        config = dataclasses.replace(env_config, observation=own.observation, action_space=own.action_space)
        env = programs.environment(config)
        player = self.trained.player(env, stack_worlds([level]))
        about = {
            "kind": self.kind,
            "path": str(self.trained.checkpoint.path),
            "num_updates": self.trained.num_updates,
            "heads": programs.heads_of(player.policy) | {"controls": programs.controls_of_outputs(env.action_space)},
            "skipped": list(self.skipped),
        }
        return Actor(env=env, player=player, about=about)


def policy_of(given: Any) -> RequestedPolicy:
    """Reads `policy` of a request. Raises RequestError or UserError."""
    if given in (KEYS, RANDOM, NOOP):
        return RequestedPolicy(kind=given)
    if isinstance(given, Mapping) and len(given) == 1:
        ((name, value),) = given.items()
        if name == "checkpoint" and isinstance(value, str) and value:
            return RequestedPolicy(kind="checkpoint", trained=checkpoint_at(Path(value)))
        if name == "run" and isinstance(value, str) and Path(value).is_absolute():
            trained, rejected = newest_checkpoint_of(Path(value))
            skipped = tuple(f"{bad.path.name}: {one_line(bad.reason)}" for bad in rejected)
            return RequestedPolicy(kind="checkpoint", trained=trained, skipped=skipped)
        if name == ACTIONS:
            return RequestedPolicy(kind=ACTIONS, actions=_actions_of(value))
    raise RequestError(
        BAD_REQUEST,
        f'policy is {repr(given)[:60]}; give "{KEYS}", "{RANDOM}", "{NOOP}", {{"run": PATH}}, {{"checkpoint": PATH}} '
        f'or {{"{ACTIONS}": [[...], ...]}}',
    )


def _actions_of(given: Any) -> np.ndarray:
    """[T, 6] int32. Raises RequestError for anything else."""
    num = PERSON_SPACE.num_dimensions
    is_table = isinstance(given, list) and all(isinstance(row, list) and len(row) == num for row in given)
    if not is_table or any(type(number) is not int or abs(number) > 2 for row in given for number in row):
        raise RequestError(BAD_REQUEST, f"policy.actions are not rows of {num} whole numbers, one a step")
    if not 0 < len(given) <= MAX_ACTIONS:
        raise RequestError(BAD_REQUEST, f"policy.actions are {len(given)} steps; give 1 to {MAX_ACTIONS}")
    actions = np.array(given, np.int32)
    try:
        PERSON_SPACE.check(actions, len(actions))
    except ValueError as error:
        raise RequestError(BAD_REQUEST, f"policy.actions: {one_line(error)}") from error
    return actions


def env_of(given: Any, size: str, trained: Trained | None = None) -> EnvConfig:
    """Environment for levels of a size: by `env` of a request, else of the policy, else the defaults.

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
    path, config = config_of_run(given, "env.run")
    with user_errors(ValueError, AttributeError, prefix=f"{path}: "):
        return env_config_of(from_dict_for_playing(config), size)
