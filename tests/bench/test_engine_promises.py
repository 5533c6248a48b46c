"""Promises of the engine on the command line: a line a scene, and an exit code that says whether all are kept."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from bench import engine_promises
from tests.engine.promises.promise import Promise, Solver, everywhere


@pytest.mark.parametrize(("figure", "verdict"), [(0.5, True), (1.5, False), (math.nan, False)])
def test_figure_is_printed_beside_its_limit(capsys: pytest.CaptureFixture[str], figure: float, verdict: bool):
    promise = Promise(name="scene", unit="m", limits=everywhere(1.0), measure=lambda solver: figure)
    assert engine_promises.report(promise, Solver()) is verdict
    line = capsys.readouterr().out
    assert line.startswith("pass" if verdict else "FAIL") and "scene" in line and "<= 1" in line


def test_scene_whose_data_is_absent_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    absent = tmp_path / "absent.json"
    promise = Promise(name="level", unit="m", limits=everywhere(1.0), measure=lambda solver: 0.0, data=absent)
    assert engine_promises.report(promise, Solver()) is None
    assert str(absent) in capsys.readouterr().out


def test_names_that_no_scene_has_are_refused(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        engine_promises.main(["--only", "perpetual motion"])
    assert stopped.value.code == 2
    assert "'perpetual motion'" in capsys.readouterr().err


def test_names_of_scenes_are_unique():
    names = [promise.name for promise in engine_promises.all_promises()]
    assert len(set(names)) == len(names) > 80
