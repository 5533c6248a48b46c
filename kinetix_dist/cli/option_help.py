"""Help for the options of a training run: everyday ones at first, a section on request, or all.

    kinetix-dist train --help               everyday options
    kinetix-dist train --help ppo.anneal    one section
    kinetix-dist train --help-all           every option, by tyro

A section is a dataclass of the configuration, an option a field; its meaning is the comment next to the field.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Sequence
from typing import Any

from kinetix_dist.errors import UserError
from kinetix_dist.near_names import did_you_mean

HELP, HELP_ALL = ("-h", "--help"), "--help-all"
WIDTH = 110
_VALUE_COLUMN, _MEANING_COLUMN = 34, 50

EVERYDAY = (
    "run.total_env_steps", "run.max_seconds", "run.seed", "run.device", "run.placement", "run.num_workers",
    "run.checkpoint_every", "run.start_from", "env.size", "env.observation", "env.action_space", "curriculum.name",
    "curriculum.levels", "policy.network", "rollout.num_envs", "rollout.num_steps", "ppo.learning_rate",
    "ppo.entropy_coefficient", "evaluation.sets", "evaluation.every", "recording.num_rollouts",
)  # fmt: skip


def wants_help(argv: Sequence[str]) -> bool:
    return bool({*HELP, HELP_ALL} & set(argv))


def options_help(argv: Sequence[str], config: Any, prog: str) -> str:
    """Text for --help and --help SECTION in `argv`. config: whose values are shown. Raises UserError for a section that
    is none."""
    sections = sections_of(config)
    position = next(index for index, word in enumerate(argv) if word in HELP)
    names = [word for word in argv[position + 1 : position + 2] if not word.startswith("-")]
    if not names:
        return "\n".join([*_everyday(config), "", *_about_sections(sections, prog)])
    name = names[0].replace("-", "_")
    if name not in sections:
        hint = did_you_mean(name, sections, f"sections are {', '.join(sections)}")
        raise UserError(f"there is no section {names[0]!r} of options; {hint}")
    lines = [_summary(sections[name]), ""]
    lines += [line for field in _options(sections[name]) for line in _option(name, field, sections[name])]
    if nested := [other for other in sections if other.startswith(f"{name}.")]:
        lines += ["", f"more in the sections {', '.join(nested)}"]
    return "\n".join(lines)


def sections_of(config: Any, prefix: str = "") -> dict[str, Any]:
    """Dataclasses of a configuration by dotted name, each before those inside it."""
    found = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            name = f"{prefix}{field.name}"
            found |= {name: value} | sections_of(value, f"{name}.")
    return found


def comments_of(section: type) -> dict[str, str]:
    """Comment next to each field, by name; fields without one are left out."""
    found = {}
    for line in inspect.getsource(section).splitlines():
        if match := re.match(r"    (\w+): [^#]*#\s*(.+)$", line):
            found[match[1]] = match[2]
    return found


def _options(section: Any) -> list[dataclasses.Field[Any]]:
    fields = dataclasses.fields(section)
    return [field for field in fields if not dataclasses.is_dataclass(getattr(section, field.name))]


def _everyday(config: Any) -> list[str]:
    sections, lines = sections_of(config), []
    for option in EVERYDAY:
        name, field_name = option.rsplit(".", 1)
        field = next(field for field in dataclasses.fields(sections[name]) if field.name == field_name)
        lines += _option(name, field, sections[name])
    return lines


def _option(name: str, field: dataclasses.Field[Any], section: Any) -> list[str]:
    """Lines "--section.field VALUE  meaning"."""
    first = f"  --{name}.{field.name} ".ljust(_VALUE_COLUMN) + _shown(getattr(section, field.name)) + "  "
    meaning = comments_of(type(section)).get(field.name, "")
    if str(field.type).startswith("Literal"):
        choices = re.findall(r"\w+", str(field.type).removeprefix("Literal"))
        meaning = "; ".join(filter(None, [f"one of {', '.join(choices)}", meaning]))
    indent = " " * _MEANING_COLUMN
    lines = textwrap.wrap(meaning, WIDTH, initial_indent=indent, subsequent_indent=indent)
    if not lines or len(first) > _MEANING_COLUMN:
        return [first.rstrip(), *lines]
    return [first.ljust(_MEANING_COLUMN) + lines[0].strip(), *lines[1:]]


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(str, value)) or "()"
    if value == "":
        return '""'
    return f"{value:,}" if type(value) is int else str(value)


def _about_sections(sections: dict[str, Any], prog: str) -> list[str]:
    lines = [f"{prog} --help SECTION shows all options of a section, {prog} --help-all those of all:"]
    for name, section in sections.items():
        lines.append(f"  {name:<24}{len(_options(section)):>3} options  {_summary(section)}")
    return lines


def _summary(section: Any) -> str:
    first = (type(section).__doc__ or "").strip().splitlines()[0]
    return textwrap.shorten(first, WIDTH - 40, placeholder=" ...")
