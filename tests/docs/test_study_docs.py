"""docs/studies.md has every field of a study, every option of the command and a section for every study."""

import dataclasses
import re

import pytest

from kinetix_dist.cli.study import Args
from kinetix_dist.study.command_file import BUILT_IN, CommandCost, CommandSmall, CommandStudy
from kinetix_dist.study.library import find_study, study_names
from kinetix_dist.study.study_file import Cost, Figure, Small, Study, StudyArm
from tests.helpers import REPOSITORY

STUDIES = (REPOSITORY / "docs" / "studies.md").read_text()
IN_WORDS = ("options", "arms", "cost", "figure", "small")  # sections, or described in words


def _fields(kind, prefix=""):
    return [(f"{prefix}{field.name}", field) for field in dataclasses.fields(kind) if field.name not in IN_WORDS]


FIELDS = [*_fields(Study), *_fields(Cost, "cost."), *_fields(Figure, "figure."), *_fields(StudyArm, "arms.")]


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_every_field_of_a_study_is_documented(name, field):
    rows = [line for line in STUDIES.splitlines() if line.startswith(f"| `{name}` |")]
    assert len(rows) == 1, name
    default = rows[0].split("|")[2].strip()
    assert default == ("" if field.default is dataclasses.MISSING else str(field.default).replace("'", '"')) or (
        default.strip('"') == str(field.default)
    )


@pytest.mark.parametrize("field", dataclasses.fields(Small), ids=lambda field: field.name)
def test_every_field_of_a_small_version_is_described(field):
    described = STUDIES.split("`[small]` has")[1].split("\n\n")[0]
    assert f"`{field.name}`" in described


@pytest.mark.parametrize("kind", [CommandStudy, CommandCost, CommandSmall], ids=lambda kind: kind.__name__)
def test_every_field_of_a_study_of_commands_is_described(kind):
    described = STUDIES.split("## A study of commands")[1].split("\n## ")[0]
    named = [field.name for field in dataclasses.fields(kind)] + list(BUILT_IN)
    assert not [name for name in named if f"`{name}`" not in described and f"`cost.{name}`" not in described]


@pytest.mark.parametrize("option", [field.name for field in dataclasses.fields(Args) if field.name != "study"])
def test_every_option_is_documented(option):
    assert f"| `--{option}` |" in STUDIES


@pytest.mark.parametrize("name", study_names())
def test_every_study_has_a_section_with_its_question_and_command(name):
    sections = re.split(r"^## ", STUDIES, flags=re.MULTILINE)
    (own,) = [section for section in sections if name in section.splitlines()[0].split(", ")]
    assert f"kinetix-dist study {name} " in own
    study = find_study(name)
    if study.finding == "not run yet":
        assert "Not run yet." in own
