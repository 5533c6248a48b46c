"""docs/training.md has every configuration field with its default, docs/operating.md every metric and event."""

import dataclasses
import math
import re

import pytest

from kinetix_dist.config import RunConfig, TrainConfig
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.recipes import RECIPES
from kinetix_dist.telemetry.event_names import EVENTS
from kinetix_dist.telemetry.names import METRICS, RED
from tests.helpers import REPOSITORY

TRAINING = (REPOSITORY / "docs" / "training.md").read_text()
OPERATING = (REPOSITORY / "docs" / "operating.md").read_text()


def _sections(config, where=""):
    """("curriculum.generator", GeneratorConfig(...)) and so on."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield f"{where}{field.name}", value
            yield from _sections(value, f"{where}{field.name}.")


SECTIONS = dict(_sections(TrainConfig(run=RunConfig(total_env_steps=1)))) | {"phases": PhaseConfig(start=1)}


@pytest.mark.parametrize("section", SECTIONS)
def test_every_field_is_documented_with_its_default(section):
    text = TRAINING.split(f"\n### {section}\n")[1].split("\n###")[0]
    documented = dict(re.findall(r"^\| `(\w+)` \| (.*?) \|", text, re.MULTILINE))
    fields = {
        f.name: f
        for f in dataclasses.fields(SECTIONS[section])
        if not dataclasses.is_dataclass(f.default_factory) and not dataclasses.is_dataclass(f.default)
    }
    expected = {name for name, f in fields.items() if f.default is not dataclasses.MISSING}
    assert documented.keys() == expected
    for name in expected:
        assert eval(documented[name], {"math": math}) == fields[name].default, name


def test_every_recipe_is_documented():
    for name in RECIPES:
        assert f"`{name}`" in TRAINING


@pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS)
def test_every_metric_is_documented(metric):
    assert f"| `{metric.name}` | {metric.unit} | {metric.meaning} |" in OPERATING


@pytest.mark.parametrize("name", RED)
def test_every_metric_that_can_be_red_is_documented_with_what_to_do(name):
    assert "| `{}` | {} | {} |".format(name, *RED[name]) in OPERATING
    assert name.replace("<role>", "worker") in METRICS


@pytest.mark.parametrize("event", EVENTS)
def test_every_event_is_documented(event):
    assert f"| `{event}` | {EVENTS[event]} |" in OPERATING
