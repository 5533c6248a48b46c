"""Options of single phases on the command line: `--phases.N.start STEPS` and `--phases.N.options.SETTING VALUE ...`.

N counts from 0. SETTING and VALUE are those of the command itself, `--phases.0.options.ppo.clip 0.1`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from kinetix_dist.errors import UserError

if TYPE_CHECKING:
    from kinetix_dist.config import TrainConfig

PREFIX = "--phases."
_OPTIONS = "options."


def split_phase_options(words: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """(other words, words of each option of a phase, its name first)."""
    others: list[str] = []
    of_phases: list[list[str]] = []
    is_of_phase = False
    for word in words:
        if word.startswith("--"):
            is_of_phase = word.startswith(PREFIX)
            if is_of_phase:
                name, has_value, value = word.partition("=")
                of_phases.append([name, value] if has_value else [name])
                continue
        if is_of_phase:
            of_phases[-1].append(word)
        else:
            others.append(word)
    return others, of_phases


def override_phases(
    config: TrainConfig,
    of_phases: Sequence[Sequence[str]],
    override: Callable[[TrainConfig, list[str]], TrainConfig],
) -> TrainConfig:
    """The config with options of its phases replaced, as `split_phase_options` gives them. override: of the command,
    (config, words) -> config. Raises UserError."""
    from kinetix_dist.config import flat, to_dict

    phases = list(config.phases)
    for option, *values in of_phases:
        number, _, name = option.removeprefix(PREFIX).replace("-", "_").partition(".")
        if not (number.isdecimal() and int(number) < len(phases)):
            have = f"phases are 0 to {len(phases) - 1}" if phases else "the recipe has no phases"
            raise UserError(f"{option}: there is no phase {number!r}; {have}, and --phases FILE replaces them")
        phase = phases[int(number)]
        if name == "start":
            if len(values) != 1 or not values[0].isdecimal():
                raise UserError(f"{option} is {' '.join(values)!r}; give a number of environment steps")
            phases[int(number)] = dataclasses.replace(phase, start=int(values[0]))
        elif name.startswith(_OPTIONS):
            setting = name.removeprefix(_OPTIONS)
            changed = override(config.schedule.phases[int(number) + 1].config, [f"--{setting}", *values])
            options = {**phase.options, setting: flat(to_dict(changed))[setting]}
            phases[int(number)] = dataclasses.replace(phase, options=options)
        else:
            raise UserError(f"{option} is no option of a phase; it has {PREFIX}N.start and {PREFIX}N.options.SETTING")
    return dataclasses.replace(config, phases=tuple(phases))
