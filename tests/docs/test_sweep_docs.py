"""docs/sweeps.md has every field of a design and every option of the command."""

import dataclasses

import pytest

from kinetix_dist.cli.sweep import Args
from kinetix_dist.sweep.design import Design, Factorial, Objective
from tests.helpers import REPOSITORY

SWEEPS = (REPOSITORY / "docs" / "sweeps.md").read_text()
# Fields that are sections, or are described in words, not in a row.
IN_WORDS = ("objective", "factorial", "arms", "halving", "options")


def _fields(kind, prefix=""):
    return [(f"{prefix}{field.name}", field) for field in dataclasses.fields(kind) if field.name not in IN_WORDS]


@pytest.mark.parametrize(("name", "field"), [*_fields(Design), *_fields(Objective, "objective."), *_fields(Factorial)])
def test_every_field_of_a_design_is_documented(name, field):
    rows = [line for line in SWEEPS.splitlines() if line.startswith(f"| `{name}` |")]
    assert len(rows) == 1, name
    default = rows[0].split("|")[2].strip()
    if isinstance(field.default, int | float) and name != "seconds":  # without halving seconds has to be given
        assert default.lower() == str(field.default).lower()


@pytest.mark.parametrize("word", ["`[options]`", "`[[arms]]`", "`[halving]`", "`rungs`", "`keep`", "`low`", "`high`"])
def test_sections_are_described(word):
    assert word in SWEEPS


@pytest.mark.parametrize("option", [field.name for field in dataclasses.fields(Args) if field.name != "design"])
def test_every_option_is_documented(option):
    assert f"| `--{option}` |" in SWEEPS
