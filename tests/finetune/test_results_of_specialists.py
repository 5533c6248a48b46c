"""Results of specialists: what is counted and stored, the directory that goes on, the picture."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.errors import UserError
from kinetix_dist.finetune.results import Key, ResultsDirectory, design_of, env_steps_to, figure_of, record_of
from kinetix_dist.finetune.specialists import SCRATCH, Point, Specialist, Start
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.recipes import recipe
from tests.finetune.small import config_of, level_directory


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return level_directory(tmp_path_factory.mktemp("results") / "levels")


def _specialist(*rates: int) -> Specialist:
    """Solved attempts of ten, every 100 steps."""
    points = tuple(Point(updates=i, env_steps=100 * i, solved=rate, attempts=10) for i, rate in enumerate(rates))
    seconds = {"training_seconds": 1.0, "evaluation_seconds": 1.0, "compile_seconds": 0.0}
    return Specialist(points=points, params={"w": np.arange(3.0)}, skipped_steps=0, **seconds)


STORED = {"checkpoint": "policy", "sha256": "abc", "policy_updates": 7}
POLICY = Start(name="policy", checkpoint="policy", description=STORED)


def test_samples_to_a_solve_rate_are_those_of_the_first_evaluation_that_has_it() -> None:
    points = _specialist(0, 4, 5, 2, 9).points
    assert [env_steps_to(points, rate) for rate in (0.0, 0.4, 0.5, 0.9, 0.95)] == [0, 100, 200, 400, None]


def test_the_picture_has_a_dot_where_the_rate_was_reached_and_a_triangle_at_the_end_where_it_was_not() -> None:
    records = [
        record_of(Key(SCRATCH, "a"), _specialist(0, 2, 6), recipe("tiny")),
        record_of(Key(SCRATCH, "b"), _specialist(0, 0, 1), recipe("tiny")),
        record_of(Key(POLICY, "a"), _specialist(7, 9, 10), recipe("tiny")),
        record_of(Key(POLICY, "b"), _specialist(0, 5, 5), recipe("tiny")),
    ]
    half, most = figure_of(records).axes
    drawn = [
        {line.get_marker(): np.asarray(line.get_xdata()).tolist() for line in panel.lines[i : i + 2]}
        for panel in (half, most)
        for i in (0, 2)
    ]
    assert drawn == [
        {"o": [200], ">": [200]},
        {"o": [0, 100], ">": []},
        {"o": [], ">": [200, 200]},
        {"o": [100], ">": [200]},
    ]
    legend = half.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "from scratch: 1 of 2",
        "from policy: 2 of 2",
    ]
    assert [label.get_text() for label in half.get_yticklabels()] == ["a", "b"]


def test_a_directory_keeps_what_is_done_and_refuses_another_design_policy_or_damage(
    directory: Path, tmp_path: Path
) -> None:
    config = config_of(directory)
    levels, names = load_level_set(str(directory), "s")
    design = design_of(config, levels, names, stop_at=0.0)
    results = ResultsDirectory(tmp_path / "out", design)
    assert results.done(Key(POLICY, "kick")) is None
    stored = results.add(Key(POLICY, "kick"), _specialist(0, 9), config, jax.tree.map(lambda x: x[1:], levels))
    with pytest.raises(UserError, match=f"in use by process {os.getpid()}; wait for it, or choose another --run"):
        ResultsDirectory(tmp_path / "out", design)
    results.close()
    again = ResultsDirectory(tmp_path / "out", design)
    assert again.done(Key(POLICY, "kick")) == stored and again.done(Key(SCRATCH, "kick")) is None

    other = dataclasses.replace(POLICY, description={"checkpoint": "elsewhere", "sha256": "def"})
    with pytest.raises(UserError, match=r"is of a specialist from another policy \(policy\)"):
        again.done(Key(other, "kick"))
    longer = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, epochs=9))
    with pytest.raises(UserError, match=r"another design: ppo\.epochs 9 instead of 2; choose another directory"):
        ResultsDirectory(tmp_path / "out", design_of(longer, levels, names, stop_at=0.0))
    with pytest.raises(UserError, match=r"another design: stop_at 0\.9 instead of 0\.0"):
        ResultsDirectory(tmp_path / "out", design_of(config, levels, names, stop_at=0.9))
    moved = dataclasses.replace(levels, position=levels.position + np.float32(0.01))
    with pytest.raises(UserError, match=r"another design: levels\.hop_home .* and 1 more"):
        ResultsDirectory(tmp_path / "out", design_of(config, moved, names, stop_at=0.0))
    (tmp_path / "out" / "policy" / "kick.json").write_text('{"level": "ki')
    with pytest.raises(UserError, match=r"kick\.json cannot be read .* its specialist is trained again"):
        again.done(Key(POLICY, "kick"))
    with pytest.raises(UserError, match=r"holds other files and no design\.json"):
        ResultsDirectory(directory, design)
