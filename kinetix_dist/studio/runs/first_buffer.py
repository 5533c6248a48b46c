"""Sentences about snapshots, counts and probes that a run does not have yet: after which update they are expected.

From the run's configuration: the kind of its curriculum, when refreshes are adopted, and when checkpoints are taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

# By the files that they leave in curriculum/; tests hold these against the registry of curricula.
REFRESHES = ("sfl", "sfl_slices")  # the first refresh is adopted at once, before its first update
REPLAYS = ("plr", "robust_plr", "accel")  # a buffer with each checkpoint
WITHOUT_BUFFER = ("domain_randomization", "fixed", "paired")


def first_buffer(config: Mapping[str, Any], update: int | None) -> str:
    """Sentence about the first snapshot of a run that has none. config: its configuration, {} where it is unknown;
    update: that it is at, None before the first."""
    if not config:
        return "It has no config.json that can be read, so that it is not known when one comes."
    if _value(config, "curriculum_log", "max_snapshots") == 0:
        return "None will come: curriculum_log.max_snapshots is 0."
    curricula = [*_curricula(config)]
    name, expected = next(((name, at) for name, at in curricula if name not in WITHOUT_BUFFER), curricula[0])
    if name in WITHOUT_BUFFER:
        return f"None will come: curriculum {name} keeps no levels that change."
    if name in REPLAYS:
        every = _value(config, "run", "checkpoint_every")
        if every is None:
            return "The first comes with the first checkpoint."
        expected = math.floor(expected / every + 1) * every
        reason = f"with the first checkpoint, run.checkpoint_every {every}"
    elif name in REFRESHES:
        reason = "training waits until its candidates are scored"
    else:
        return f"Curriculum {name} is of a plugin: its documentation says what it keeps."
    return _expectation("buffer", expected, reason, update)


def first_outcomes(config: Mapping[str, Any], update: int | None) -> str:
    """The same of counts of training episodes, outcomes.jsonl."""
    if not config:
        return "It has no config.json that can be read, so that it is not known when they come."
    every = _value(config, "curriculum_log", "outcomes_every")
    if every == 0:
        return "None will come: curriculum_log.outcomes_every is 0."
    if every is None:
        return "The first come after curriculum_log.outcomes_every updates."
    return _expectation("counts", every, "or when the buffer changes", update)


def next_probe(config: Mapping[str, Any], refreshes: Sequence[int], *, is_over: bool) -> str:
    """Sentence about when it is known what was learned from the newest buffer: its next refresh plays it again.

    refreshes: numbers of those that are there, oldest first; one or more.
    """
    if not config:
        return (
            "It has no config.json that can be read, so that it is not known whether the next refresh plays it again."
        )
    levels, every = _value(config, "curriculum_log", "probe_levels"), _value(config, "curriculum_log", "probe_every")
    if not levels:
        return "Not measured: curriculum_log.probe_levels is 0, so that no refresh plays levels again."
    if every and len(refreshes) % every:
        return f"Not measured: only every {every}. refresh plays levels again (curriculum_log.probe_every)."
    if is_over:
        return f"Not known: the run ended before the refresh that would have played buffer {refreshes[-1]} again."
    step = _value(config, "curriculum", "refresh_every")
    if step is None:
        return "Not known yet: the next refresh plays this buffer again."
    return (
        f"Not known yet: refresh {refreshes[-1] + step} plays buffer {refreshes[-1]} again "
        f"(curriculum.refresh_every {step})."
    )


def _expectation(noun: str, expected: int, reason: str, update: int | None) -> str:
    done = update or 0
    if done <= expected:
        return f"First {noun} expected after update {expected} ({reason}); the run is at update {done}."
    return (
        f"First {noun} expected after update {expected} ({reason}), but the run is at update {done}: a disk did not "
        "take the file (event sink_failing), it was removed, or the version of this run writes none."
    )


def _curricula(config: Mapping[str, Any]) -> list[tuple[str, int]]:
    """(name, first update) of the curricula of a run, by its phases."""
    names = [(str(_value(config, "curriculum", "name")), 0)]
    steps = (_value(config, "rollout", "num_envs") or 0) * (_value(config, "rollout", "num_steps") or 0)
    phases = config.get("phases")
    for phase in phases if isinstance(phases, list) else ():
        options, start = (phase.get("options"), phase.get("start")) if isinstance(phase, dict) else (None, None)
        if isinstance(options, dict) and "curriculum.name" in options and isinstance(start, int) and steps:
            names.append((str(options["curriculum.name"]), -(-start // steps)))
    return names


def _value(config: Mapping[str, Any], section: str, name: str) -> Any:
    values = config.get(section)
    return values.get(name) if isinstance(values, dict) else None
