"""`bench env`: a record for each observation, failures that say what fits, refused options."""

from __future__ import annotations

import json

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.env import device_memory


def test_a_record_for_each_observation(tmp_path, capsys):
    file = tmp_path / "env.json"
    options = "--sizes s --observations flat --worlds 8 --steps 2 --repeats 3"
    assert main(["bench", "env", *options.split(), "--json", str(file)]) == 0
    records = json.loads(file.read_text())
    assert [(record["observation"], record["size"], record["worlds"]) for record in records] == [
        ("none", "s", 8),
        ("flat", "s", 8),
    ]
    assert records[0]["relative_to_none"] == 1.0
    assert all(record["env_steps_per_second"] > 0 for record in records)
    assert "environment steps/s" in capsys.readouterr().out


def test_worlds_of_which_the_pictures_do_not_fit_are_a_failure_that_says_how_many_do(monkeypatch, capsys):
    monkeypatch.setattr(device_memory, "device_bytes", lambda: 2**20)
    options = "--sizes s --observations pixels --worlds 8 --steps 2 --repeats 3"
    assert main(["bench", "env", *options.split()]) == 1
    assert "failed: pixels, S, 8 worlds: observations 'pixels' of worlds: 8 take" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--sizes xl", "xl is unknown; choose from s, m, l"),
        ("--worlds 0", "--worlds is 0; it must be 1 or more"),
        ("--observations sound", "sound is unknown"),
    ],
)
def test_bad_options_are_refused(option, message, capsys):
    assert main(["bench", "env", *option.split()]) == 2
    assert message in capsys.readouterr().err
