"""docs/dashboard.md has every rule of the warnings and every option of the command."""

from __future__ import annotations

import dataclasses

import pytest

from kinetix_dist.cli.dashboard import Args
from kinetix_dist.studio.runs.warnings import RULES, Rule
from kinetix_dist.telemetry.names import METRICS
from tests.helpers import REPOSITORY

TEXT = (REPOSITORY / "docs" / "dashboard.md").read_text()


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.metric)
def test_every_rule_is_documented_and_is_about_a_metric(rule: Rule) -> None:
    assert f"| `{rule.metric}` | {rule.condition} |" in TEXT
    assert rule.metric in METRICS


def test_every_option_is_documented_with_its_default() -> None:
    for field in dataclasses.fields(Args):
        if field.name != "paths":
            negation = "no-" if field.default is True else ""  # of what is on by default
            assert f"| `--{negation}{field.name.replace('_', '-')}` |" in TEXT
    assert f"| `--port` | {Args().port} |" in TEXT and f"| `--host` | {Args().host} |" in TEXT
