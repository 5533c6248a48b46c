"""Settings of a stranger that no machine can run, and values of another form: refused in one short line."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from jax2d.settings import COUNTS, Settings
from kinetix_dist.config import curriculum_from_dict, from_dict, from_dict_for_playing, to_dict
from kinetix_dist.curator.config import CurriculumConfig, PairedConfig
from kinetix_dist.delay.chunk_policy import FlowConfig
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.size_mixture import check_weights
from kinetix_dist.models.policy import PolicyConfig
from kinetix_dist.recipes import recipe
from kinetix_dist.setting import ConfigError

HUGE = 2**62
# Config -> its whole numbers that no array and no program has a part for, each with the reason.
UNLIMITED: dict[type, dict[str, str]] = {
    PolicyConfig: {},
    EnvConfig: {},
    Settings: {},
    FlowConfig: {"max_delay": "it is less than horizon"},
    PairedConfig: {"epochs": "training alone reads it"},
    GeneratorConfig: {"min_revolute_joints": "a number of joints is compared with it"},
}
SIZES = [
    (kind, field.name)
    for kind, free in UNLIMITED.items()
    for field in dataclasses.fields(kind)
    if field.type == "int" and field.name not in free
]


@pytest.mark.parametrize(("kind", "name"), SIZES, ids=lambda value: getattr(value, "__name__", value))
def test_every_size_has_an_upper_limit(kind: type, name: str) -> None:
    with pytest.raises(ValueError, match=rf"{kind.__name__}\.{name} is {HUGE}; it must be from \d+ to \d+$"):
        kind(**{name: HUGE})


def test_a_delay_beyond_the_chunk_is_refused() -> None:
    with pytest.raises(ConfigError, match="it must be less"):
        FlowConfig(max_delay=HUGE)


def test_all_whole_numbers_of_the_solver_are_limited() -> None:
    assert set(COUNTS) == {field.name for field in dataclasses.fields(Settings) if field.type == "int"}


@pytest.mark.parametrize("section", ["policy", "env"])
def test_a_stored_size_is_refused_as_it_is_read(section: str) -> None:
    stored = to_dict(recipe("tiny"))
    name = {"policy": "num_layers", "env": "max_steps"}[section]
    stored[section][name] = HUGE
    with pytest.raises(ConfigError, match=rf"{name} is {HUGE}; it must be from 1 to"):
        from_dict_for_playing(stored)


@pytest.mark.parametrize(
    "name",
    [
        "circle_size_factor",
        "max_shape_size",
        "min_half_extent",
        "min_radius",
        "large_rectangle_scale",
        "limit_max",
        "motor_speed_max",
        "motor_power_max",
    ],
)
def test_a_setting_of_the_generator_that_levels_are_divided_by_is_above_0(name: str) -> None:
    zero: dict[str, Any] = {name: 0.0}
    with pytest.raises(ConfigError, match=rf"GeneratorConfig\.{name} is 0\.0; it must be above 0"):
        GeneratorConfig(**zero)


@pytest.mark.parametrize("sizes", [[[[], 1]], [5], [["s"]], [["s", 1, 2]], [[None, 1]], [["s", "1"]], [["s", True]], 5])
def test_sizes_of_another_form_are_refused(sizes: Any) -> None:
    stored = to_dict(recipe("tiny"))
    stored["curriculum"]["sizes"] = sizes
    with pytest.raises(ConfigError, match=r"sizes (has|gives|is)"):
        curriculum_from_dict(stored)


def test_sizes_that_are_whole_numbers_stay_as_they_are() -> None:
    check_weights("sizes", (("s", 1), ("m", 2)))
    assert CurriculumConfig(sizes=(("s", 1),)).sizes == (("s", 1),)  # a config's hash depends on it


@pytest.mark.parametrize(
    "phases", [5, "x", {}, {"a": 1}, None, [5], [None], [{"start": 5, "options": 5}], [{"start": 5, "options": None}]]
)
def test_phases_of_another_form_are_refused(phases: Any) -> None:
    stored = to_dict(recipe("tiny")) | {"phases": phases}
    with pytest.raises(ConfigError, match=r"config field phases"):
        from_dict(stored)
    from_dict_for_playing(stored)  # it does not read phases


def test_a_field_within_a_value_that_is_no_section_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"'a\.b' is within 'a', which is no section"):
        from_dict_for_playing({"a": 1, "a.b": 2})


LONG = "\x1b[2J" + "x" * 100_000


@pytest.mark.parametrize("kind", [PolicyConfig, EnvConfig, Settings])
def test_a_complaint_about_any_field_is_short_and_printable(kind: type) -> None:
    where = {PolicyConfig: ("policy",), EnvConfig: ("env",), Settings: ("env", "physics")}[kind]
    for name in [*(field.name for field in dataclasses.fields(kind)), LONG]:
        stored = to_dict(recipe("tiny"))
        section = stored
        for part in where:
            section = section[part]
        section[name] = LONG
        with pytest.raises(ConfigError) as caught:
            from_dict_for_playing(stored)
        message = str(caught.value)
        assert message.isprintable() and len(message) <= 2000, name


def test_a_complaint_about_a_setting_that_is_gone_is_short_and_printable() -> None:
    with pytest.raises(ConfigError) as caught:
        from_dict({"curriculum": {"learnable_only": LONG}})
    assert str(caught.value).isprintable() and len(str(caught.value)) <= 2000
