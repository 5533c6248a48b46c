"""`kinetix-dist levels stats`: its numbers are those that the package's parameters promise, and files are checked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.cli.level_stats import summary
from kinetix_dist.cli.main import main
from kinetix_dist.level.statistics import Distribution, Share, describe, read

NUM_LEVELS = 1000
PUBLISHED = Path(__file__).parent.parent / "level" / "data" / "published_levels.json"


def test_the_report_of_the_public_distribution_lies_in_the_ranges_of_its_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "m.json"
    options = ["--generator", "kinetix", "--levels", str(NUM_LEVELS), "--seed", "3"]
    assert main(["levels", "stats", *options, "--json", str(file), "--reference", str(PUBLISHED)]) == 0
    printed = capsys.readouterr().out
    assert "1,000 levels of size M, generator kinetix, seed 3" in printed
    assert "0 of 80 statistics are more than 4.5 standard errors apart" in printed
    document = json.loads(file.read_text())
    assert {key: document[key] for key in ("generator", "levels", "seed")} == {
        "generator": "kinetix", "levels": NUM_LEVELS, "seed": 3,
    }  # fmt: skip
    found = read(document["sizes"]["m"])

    def assert_share(name: str, chance: float, low: float = 0.0, high: float = 0.0) -> None:
        """Within four standard errors of the chance, or of the range from low to high around it."""
        share = found[name]
        assert isinstance(share, Share)
        error = 4.0 * np.sqrt(chance * (1.0 - chance) / share.total)
        assert chance - low - error <= share.value <= chance + high + error, (name, share.value)

    for name, chance in {
        "floor is none": 0.90,
        "floor is green": 0.0,
        "floor is blue": 0.02,
        "floor is red": 0.08,
        "motor on, of hinges": 0.8,
        "limits, of polygon and polygon": 0.4,
        "limits, of polygon and circle": 0.0,
        "thruster colour 0": 0.5,
        **{f"motor colour {k}": 0.25 for k in range(4)},
    }.items():
        assert_share(name, chance)
    # Along the line through the centre: 0.8, half of it each way; chance directions add a little.
    assert_share("thruster pushes outwards", 0.4)
    assert_share("thruster pushes inwards", 0.4)
    # Two thirds have a forced thruster, of the others three in ten get the second slot's.
    assert_share("thrusters 0", (1 / 3) * 0.7)
    # No forced thruster (1/3), its forced motor off (1 - 0.8) and nothing else by chance: at most a third of a fifth.
    assert_share("no control at all", 0.03, low=0.03, high=0.04)
    for name, low, high in (
        ("speed, absolute", 0.4, 3.0),
        ("power, of polygon and polygon", 1.0, 3.0),
        ("power, of polygon and circle", 1.0, 1.0),
        ("thruster power over mass", 1.0, 4.0),
        ("radius", 0.1, 0.4),
        ("half extents, smaller", 0.05, 0.5),
    ):
        numbers = found[name]
        assert isinstance(numbers, Distribution)
        assert low - 1e-4 <= numbers.points[0] and numbers.points[-1] <= high + 1e-4, name
    speeds = found["speed, absolute"]
    assert isinstance(speeds, Distribution)
    np.testing.assert_allclose(np.interp(0.5, speeds.shares, speeds.points), 1.7, atol=0.15)  # uniform


def test_numbers_are_shown_alike_from_a_sample_and_from_its_description() -> None:
    sample = np.linspace(0.0, 1.0, 10_001)
    described = read(describe({"numbers": sample, "share": Share(hits=1, total=3)}))
    assert summary(sample) == summary(described["numbers"]) == "0.5 (0.05 to 0.95)"
    assert summary(described["share"]) == "33.3% of 3"
    assert summary(Share(hits=0, total=0)) == summary(np.zeros(0)) == "none"


def test_what_is_wrong_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.json"
    other.write_text("{}")
    for options, says in (
        (["--levels", "0"], "--levels is 0; draw 1 or more"),
        (["--generator", "nosuch"], "unknown generator 'nosuch'; generators are default, kinetix"),
        (["--reference", str(other)], "has no statistics of size m"),
        (["--reference", str(tmp_path / "no.json")], "No such file"),
        (["--json", str(tmp_path / "no" / "x.json")], "give --json a file in a directory that exists"),
        (["--json", str(tmp_path)], "give --json a file in a directory that exists"),
        (["--seed", "99999999999999999999"], "--seed is 99999999999999999999; give a number from 0 to 4294967295"),
        (["--seed", "-1"], "--seed is -1; give a number from 0"),
        (["--size", "xl"], "kinetix-dist: invalid choice 'xl' for argument '--size'"),
    ):
        assert main(["levels", "stats", *options]) == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1


def test_a_kind_that_the_size_has_no_room_for_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["levels", "stats", "--generator", "runner", "--size", "s", "--levels", "8"]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "no family of mechanism_families runner has room" in line
