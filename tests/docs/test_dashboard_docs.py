"""docs/dashboard.md has every rule of the warnings, every normal range and every option of the command."""

from __future__ import annotations

import dataclasses

import pytest

from kinetix_dist.cli.dashboard import Args
from kinetix_dist.studio.runs.warnings import RULES, Rule
from kinetix_dist.telemetry.names import METRICS
from kinetix_dist.telemetry.sections import NORMAL, OTHER, SECTIONS, section_of
from tests.helpers import REPOSITORY

TEXT = (REPOSITORY / "docs" / "dashboard.md").read_text()


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.metric)
def test_every_rule_is_documented_and_is_about_a_metric(rule: Rule) -> None:
    part = rule.part.capitalize() or "its own"
    assert f"| `{rule.metric}` | {rule.condition} | {part} |" in TEXT
    assert rule.metric in METRICS


def test_every_option_is_documented_with_its_default() -> None:
    for field in dataclasses.fields(Args):
        if field.name != "paths":
            negation = "no-" if field.default is True else ""  # of what is on by default
            assert f"| `--{negation}{field.name.replace('_', '-')}` |" in TEXT
    assert f"| `--port` | {Args().port} |" in TEXT and f"| `--host` | {Args().host} |" in TEXT


@pytest.mark.parametrize("name", NORMAL)
def test_every_normal_range_is_documented_and_is_of_a_metric(name: str) -> None:
    row = next(
        (line for line in TEXT.splitlines() if line.startswith("| `") and f"`{name}`" in line.split(" | ")[0]), ""
    )
    high = NORMAL[name].high
    assert f"| {f'below {high / 1000:.0f} k' if high else '0'} |" in row
    assert name in METRICS


def test_every_metric_has_a_section() -> None:
    assert {section_of(name) for name in METRICS} == SECTIONS.keys() - {OTHER}
    assert section_of("mine/reward") == OTHER, "of a plugin"
