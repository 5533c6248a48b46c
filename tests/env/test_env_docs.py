"""docs/environment.md says what the code does."""

from __future__ import annotations

import dataclasses
import re

import pytest

from jax2d import preset
from kinetix_dist.env.environment import EnvConfig
from kinetix_dist.env.observations.entities import EntityObs
from tests.helpers import REPOSITORY

TEXT = (REPOSITORY / "docs" / "environment.md").read_text()


def test_every_setting_is_listed_with_its_default() -> None:
    listed = dict(re.findall(r"^\| `(\w+)` \| `?(.+?)`? \|", TEXT.split("## Settings")[1].split("##")[0], re.MULTILINE))
    assert listed.keys() == {field.name for field in dataclasses.fields(EnvConfig)}
    for field in dataclasses.fields(EnvConfig):
        assert eval(listed[field.name], {"preset": preset}) == field.default, field.name


def test_every_array_of_an_observation_is_listed() -> None:
    for field in dataclasses.fields(EntityObs):
        assert f"`{field.name}`" in TEXT


def test_the_example_of_a_wrapper_runs() -> None:
    example = TEXT.split("```python\n")[2].split("```")[0]
    names: dict = {}
    exec(compile(example, "docs/environment.md", "exec"), names)
    assert names["obs"] in names["envs"].observation_space


@pytest.mark.long
def test_the_example_runs() -> None:
    example = TEXT.split("```python\n")[1].split("```")[0]
    names: dict = {}
    exec(compile(example, "docs/environment.md", "exec"), names)
    assert names["policy_input"].polygons.shape == (8, 5, 27)
