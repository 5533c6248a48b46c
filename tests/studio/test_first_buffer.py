"""Sentences of a run that has just begun: when its first buffer and its first counts are expected."""

from __future__ import annotations

from typing import Any

import pytest

from kinetix_dist.studio.runs.first_buffer import (
    REFRESHES,
    REPLAYS,
    WITHOUT_BUFFER,
    first_buffer,
    first_outcomes,
    next_probe,
)


def config_of(name: str, **more: Any) -> dict[str, Any]:
    config = {
        "curriculum": {"name": name, "refresh_every": 128, "adopt_after": 4},
        "curriculum_log": {"max_snapshots": 64, "outcomes_every": 16},
        "rollout": {"num_envs": 10, "num_steps": 10},
        "run": {"checkpoint_every": 100},
    }
    return config | more


def test_each_curriculum_of_this_version_is_known() -> None:
    from kinetix_dist.curator.curricula import CURRICULA
    from kinetix_dist.curator.curriculum import Curriculum

    for name in CURRICULA:
        kind = CURRICULA[name]
        if not kind.__module__.startswith("kinetix_dist."):  # registered by an example that another test imported
            continue
        has_buffer_log = kind.buffer_log.__func__ is not Curriculum.buffer_log.__func__
        assert (name in REFRESHES) == kind.refreshes, name
        assert (name in REPLAYS) == (has_buffer_log and not kind.refreshes), name
        assert (name in WITHOUT_BUFFER) == (not has_buffer_log and not kind.refreshes), name


@pytest.mark.parametrize(
    ("config", "update", "text"),
    [
        (
            config_of("sfl"),
            None,
            "First buffer expected after update 0 (training waits until its candidates are scored)",
        ),
        (
            config_of("plr"),
            7,
            "First buffer expected after update 100 (with the first checkpoint, run.checkpoint_every 100)",
        ),
        (config_of("plr"), 7, "the run is at update 7."),
        (
            config_of("plr"),
            101,
            "after update 100 (with the first checkpoint, run.checkpoint_every 100), but the run is",
        ),
        (config_of("domain_randomization"), 7, "None will come: curriculum domain_randomization keeps no levels"),
        (
            config_of("sfl", curriculum_log={"max_snapshots": 0}),
            7,
            "None will come: curriculum_log.max_snapshots is 0.",
        ),
        (config_of("mine"), 7, "Curriculum mine is of a plugin"),
        ({}, None, "no config.json that can be read"),
        (
            config_of("fixed", phases=[{"start": 950, "options": {"curriculum.name": "sfl"}}]),
            3,
            "First buffer expected after update 10 (training waits",
        ),
        (
            config_of("fixed", phases=[{"start": 25_000, "options": {"curriculum.name": "accel"}}]),
            3,
            "First buffer expected after update 300 (with the first checkpoint",
        ),
    ],
)
def test_the_first_buffer(config: dict[str, Any], update: int | None, text: str) -> None:
    sentence = first_buffer(config, update)
    assert text in sentence
    assert ("version of this run" in sentence) == (update == 101), "only where it is late"


def test_the_first_counts() -> None:
    assert "after update 16 (or when the buffer changes); the run is at update 2." in first_outcomes(
        config_of("sfl"), 2
    )
    assert "but the run is at update 17" in first_outcomes(config_of("sfl"), 17)
    assert first_outcomes(config_of("sfl", curriculum_log={"outcomes_every": 0}), 2).startswith("None will come")
    assert "not known" in first_outcomes({}, None)


@pytest.mark.parametrize(
    ("log", "refreshes", "is_over", "text"),
    [
        ({"probe_levels": 64, "probe_every": 1}, [0, 128], False, "Not known yet: refresh 256 plays buffer 128 again"),
        ({"probe_levels": 64, "probe_every": 1}, [0, 128], True, "Not known: the run ended before the refresh"),
        ({"probe_levels": 64, "probe_every": 2}, [0], False, "Not measured: only every 2. refresh plays levels again"),
        ({"probe_levels": 64, "probe_every": 2}, [0, 128], False, "Not known yet: refresh 256"),
        ({"probe_levels": 0, "probe_every": 1}, [0], False, "Not measured: curriculum_log.probe_levels is 0"),
    ],
)
def test_when_it_is_known_what_was_learned(log: dict[str, int], refreshes: list[int], is_over: bool, text: str) -> None:
    assert next_probe(config_of("sfl", curriculum_log=log), refreshes, is_over=is_over).startswith(text)
    assert "not known whether" in next_probe({}, refreshes, is_over=is_over)
