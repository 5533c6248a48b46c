"""`bench levels`: a record for each size and generator; refused options."""

from __future__ import annotations

import json

import pytest

from kinetix_dist.cli.main import main


@pytest.mark.long
def test_a_record_of_each_generator(tmp_path, capsys):
    file = tmp_path / "levels.json"
    assert main(["bench", "levels", "--sizes", "s", "--levels", "64", "--repeats", "2", "--json", str(file)]) == 0
    (record,) = json.loads(file.read_text())
    assert (record["size"], record["generator"], record["levels"]) == ("s", "default", 64)
    assert 0 < record["levels_per_second"] < record["drawn_per_second"]
    assert 0 < record["solved_without_actions"] < 0.4  # about one in ten; 128 levels
    assert "filtered levels/s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--sizes xl", "xl is unknown; choose from s, m, l"),
        ("--levels 0", "--levels is 0; it must be 1 or more"),
        ("--generators chance", "unknown generator 'chance'"),
    ],
)
def test_bad_options_are_refused(option, message, capsys):
    assert main(["bench", "levels", *option.split()]) == 2
    assert message in capsys.readouterr().err
