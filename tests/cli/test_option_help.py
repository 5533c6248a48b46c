"""`train --help` fits two screens; every option is shown by its section, or by --help-all."""

from __future__ import annotations

import re

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.cli.option_help import EVERYDAY, comments_of, sections_of
from kinetix_dist.config import RunConfig, flat, to_dict
from kinetix_dist.recipes import recipe


def _help(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main(["train", *arguments])
    assert stop.value.code == 0
    return capsys.readouterr().out


def _options(text):
    return set(re.findall(r"^  --([a-z_]+\.[a-z_.]+)", text, flags=re.MULTILINE))


def test_help_is_short_and_names_the_sections(capsys):
    text = _help(capsys, "--help")
    assert len(text.splitlines()) <= 75 and max(map(len, text.splitlines())) <= 115
    assert _options(text) - {"env.preset", "curriculum.generator"} == set(EVERYDAY)
    for section in sections_of(recipe("tiny")):
        assert re.search(rf"^  {re.escape(section)} +\d+ options", text, flags=re.MULTILINE)
    assert "--help SECTION" in text and "--help-all" in text


def test_sections_together_have_every_option_with_its_value(capsys):
    config = recipe("pretrain_m")
    shown = set()
    for section in sections_of(config):
        shown |= _options(_help(capsys, "--recipe", "pretrain_m", "--help", section))
    shown -= {"env.preset", "curriculum.generator"}  # of the usage
    assert shown == {name for name in flat(to_dict(config)) if not name.startswith("phases")}


def test_an_option_has_its_value_in_the_recipe_and_its_meaning(capsys):
    text = _help(capsys, "--recipe", "tiny", "--help", "run.limits")
    assert re.search(r"^  --run\.limits\.save +600\.0 +copying a checkpoint off the devices$", text, flags=re.MULTILINE)
    assert comments_of(RunConfig)["checkpoint_every"] == "updates"


def test_all_options_are_there_on_request(capsys):
    text = _help(capsys, "--help-all")
    for name in flat(to_dict(recipe("tiny"))):
        if not name.startswith("phases"):
            assert f"--{name.replace('_', '-')}" in text


def test_a_section_that_is_none_is_one_line_with_the_nearest(capsys):
    assert main(["train", "--help", "curiculum.plr"]) == 2
    assert capsys.readouterr().err == (
        "kinetix-dist: there is no section 'curiculum.plr' of options; did you mean 'curriculum.plr'?\n"
    )


def test_no_option_is_a_negation_whose_opposite_would_be_two(capsys):
    for command in (["dashboard"], ["edit"], ["eval"], ["doctor"], ["replay"], ["sweep"], ["levels", "play"]):
        with pytest.raises(SystemExit):
            main([*command, "--help"])
        text = capsys.readouterr().out
        assert "--no-no" not in text
    assert "--play, --no-play" in text
