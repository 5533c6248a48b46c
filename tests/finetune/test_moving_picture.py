"""Specialists as a moving picture: who is shown, what the captions say, what happens where a policy is gone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.GifImagePlugin import GifImageFile

from kinetix_dist.cli.main import main
from kinetix_dist.finetune.moving_picture import NUM_ATTEMPTS, num_columns, play_specialists
from kinetix_dist.finetune.results import Key, record_of
from kinetix_dist.finetune.specialists import Point, Specialist, policy_at, start_from
from kinetix_dist.stored_specialists import read_results
from tests.finetune.small import NAMES, config_of, level_directory, write_policy

STEPS = 384


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """What `finetune --each` stores of two specialists that learned nothing, in `out`; they started from `policy`."""
    config = config_of(level_directory(tmp_path / "levels"))
    start = start_from(policy_at(write_policy(tmp_path / "policy", config)))
    out = tmp_path / "out"
    (out / start.name).mkdir(parents=True)
    design = {"levels": dict.fromkeys(NAMES, ""), "curriculum": {"levels": str(tmp_path / "levels")}}
    (out / "design.json").write_text(json.dumps(design))
    points = tuple(Point(updates=steps // 128, env_steps=steps, solved=0, attempts=8) for steps in (0, STEPS))
    seconds = {"training_seconds": 1.0, "evaluation_seconds": 1.0, "compile_seconds": 0.0}
    specialist = Specialist(points=points, params={"w": np.arange(3.0)}, skipped_steps=0, **seconds)
    for name in NAMES:
        (out / start.name / f"{name}.json").write_text(json.dumps(record_of(Key(start, name), specialist, config)))
        write_policy(out / start.name / name, config)
    return out


def test_each_level_is_shown_before_and_after_at_most_one_frame_in_a_fifteenth_of_a_second(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    played = play_specialists(results, read_results(results))
    moments = ("before", f"after {STEPS} steps")
    assert [(one.level, one.moment) for one in played] == [(name, when) for name in NAMES for when in moments]
    for before, after in zip(played[::2], played[1::2]):  # the same policy and keys here
        np.testing.assert_array_equal(before.rollout.position, after.rollout.position)
        assert after.caption == f"{after.level} after 384 steps: {after.num_solved} of {NUM_ATTEMPTS} solved"
        assert after.rollout.solved == (after.num_solved > 0)

    gif = results.parent / "after.gif"
    assert main(["finetune", "--draw", str(results), "--gif", str(gif)]) == 0
    assert capsys.readouterr().out.endswith(f"gif      {gif}\n")
    longest = max(one.rollout.num_steps for one in played)  # of 1/30 s
    with Image.open(gif) as image:
        assert isinstance(image, GifImageFile) and image.n_frames == 1 + -(-longest // 2)


def test_a_start_that_is_gone_is_left_out_and_levels_that_are_gone_are_one_line(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (results.parent / "policy").rename(results.parent / "elsewhere")
    assert [one.moment for one in play_specialists(results, read_results(results)[:1])] == ["after 384 steps"]
    (results.parent / "levels").rename(results.parent / "others")
    assert main(["finetune", "--draw", str(results), "--gif", str(results.parent / "a.gif")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"kinetix-dist: there is no level file or directory {results.parent / 'levels'}")


@pytest.mark.parametrize("curriculum", [None, [], {}, {"levels": 3}])
def test_a_design_without_its_levels_is_one_line(
    curriculum: object, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (results / "design.json").write_text(json.dumps({"levels": dict.fromkeys(NAMES, ""), "curriculum": curriculum}))
    assert main(["finetune", "--draw", str(results), "--gif", str(results.parent / "a.gif")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "design.json is damaged: it does not name its levels" in line


@pytest.mark.parametrize(
    ("num_pictures", "in_pairs", "columns"), [(1, False, 1), (2, True, 2), (4, True, 2), (12, False, 4)]
)
def test_columns_of_a_moving_picture(num_pictures: int, in_pairs: bool, columns: int) -> None:
    assert num_columns(num_pictures, in_pairs=in_pairs) == columns
    assert not in_pairs or num_columns(5 * num_pictures, in_pairs=True) % 2 == 0
