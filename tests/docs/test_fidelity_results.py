"""Figures of docs/engine_accuracy.md against the records of the study in docs/results/engine. Runs no engine."""

from __future__ import annotations

import csv
import gzip
from decimal import Decimal
from pathlib import Path
from typing import Any, cast

import pytest

from jax2d.fidelity.closed_forms import CLOSED_FORMS
from jax2d.fidelity.frontier import accepted, points_of, scenes_of_means, setting_key
from jax2d.fidelity.records import Record
from jax2d.fidelity.report import beaten_scenes
from tests.helpers import REPOSITORY

Key = tuple[str, str, str, str]  # as `frontier.setting_key`
STUDY = REPOSITORY / "docs/results/engine/study_cpu.csv.gz"  # the one that docs/engine_accuracy.md shows
ENGINE = (REPOSITORY / "docs/engine_accuracy.md").read_text()
SECTION = ENGINE[ENGINE.index("## What accuracy costs") :]

STANDARD: Key = ("standard", "warp", "float32", "dt 1/60, 4 substeps")
DRAFT: Key = ("draft", "warp", "float32", "dt 1/60, 2 substeps")
FINE: Key = ("fine", "warp", "float32", "dt 1/60, 16 substeps, contacts to 1000 Hz")
PAPER: Key = ("paper", "warp", "float32", "dt 1/60, 10 iterations")
BOX2D: Key = ("box2d", "box2d", "float32", "dt 1/60, 8 iterations")
PUBLISHED: Key = ("published-jax2d", "xla", "float32", "dt 1/60, 10 iterations")


def standard(setting: str, backend: str = "warp", dtype: str = "float32") -> Key:
    return "standard", backend, dtype, setting


ROWS = {
    "standard at dt 1/30": standard("dt 1/30, 4 substeps"),
    "paper": PAPER,
    "draft": DRAFT,
    "standard": STANDARD,
    "Box2D 2.3, dt 1/60, one world at a time": BOX2D,
    "standard with 8 sub-steps and stiffness that rises with them": standard(
        "dt 1/60, 8 substeps, contacts to 1000 Hz"
    ),
    "standard at dt 1/120": standard("dt 1/120, 4 substeps"),
    "fine": FINE,
    "standard at dt 1/120, 16 sub-steps, stiffness rising with them": standard(
        "dt 1/120, 16 substeps, contacts to 1000 Hz"
    ),
    "published jax2d, dt 1/60": PUBLISHED,
    "standard in plain JAX, float64": standard("dt 1/60, 4 substeps", "xla", "float64"),
}
COLUMNS = {
    "draft": DRAFT,
    "standard": STANDARD,
    "dt 1/120": standard("dt 1/120, 4 substeps"),
    "no warm start": standard("dt 1/60, 4 substeps, no warm start"),
    "fine": FINE,
    "paper": PAPER,
    "Box2D": BOX2D,
    "published": PUBLISHED,
}


def records(file: Path) -> list[Record]:
    """Records that `jax2d.fidelity.report.write_csv` wrote; without an error where the motion is not finite."""
    with gzip.open(file, "rt", newline="") as lines:
        rows: list[dict[str, Any]] = list(csv.DictReader(lines))
    assert set(rows[0]) == set(Record.__annotations__)
    for row in rows:
        row["error"] = float(row["error"]) if row["error"] else None
        row["us_per_world_second"] = float(row["us_per_world_second"])
    return cast(list[Record], rows)


@pytest.fixture(scope="module")
def shown_study() -> list[Record]:
    return records(STUDY)


def table(first_cell: str) -> list[list[str]]:
    """Rows of the table of that page whose header starts with this cell; without emphasis and thousands commas."""
    lines = SECTION[SECTION.index(f"\n| {first_cell} |") + 1 :].split("\n\n", maxsplit=1)[0].splitlines()
    rows = [[cell.strip(" `*").replace("`", "") for cell in line.strip("|").split("|")] for line in lines]
    return [rows[0], *rows[2:]]


def shows(cell: str, value: float | None) -> bool:
    """True if a cell is the value, rounded to the digits that the cell has."""
    number = Decimal(cell.replace(",", ""))
    last_digit = Decimal(1).scaleb(int(number.as_tuple().exponent))
    return value is not None and abs(float(number) - value) <= 0.501 * float(last_digit)


def test_published_engine_dominates_standard_in_no_scene(shown_study: list[Record]):
    """None of its settings is as cheap and as accurate, and better in one of the two."""
    ours, theirs = ({r["scene"] for r in shown_study if setting_key(r)[0] == key[0]} for key in (STANDARD, PUBLISHED))
    assert len(ours) >= 50
    assert len(ours & theirs) >= 45
    assert beaten_scenes(shown_study, "standard", PUBLISHED[0]) == []


def test_a_scene_in_which_the_published_engine_dominated_would_be_found(shown_study: list[Record]):
    better = [
        r | {"us_per_world_second": 0.1} if setting_key(r) == PUBLISHED and r["scene"] == "chain_gap" else r
        for r in shown_study
    ]
    assert beaten_scenes(better, "standard", PUBLISHED[0]) == ["chain_gap"]  # type: ignore[arg-type]


def test_table_of_means_is_that_of_the_records(shown_study: list[Record]):
    scenes = scenes_of_means(shown_study)
    closed = [scene for scene in scenes if scene in CLOSED_FORMS]
    assert f"{len(closed)} closed forms and {len(scenes) - len(closed)} reference scenes" in SECTION
    kinds = (scenes, closed, [scene for scene in scenes if scene not in closed])
    everything, *of_kind = ({point[:4]: point for point in points_of(shown_study, kind)} for kind in kinds)
    _, *rows = table("setting")
    assert [row[0] for row in rows] == list(ROWS)
    for name, *cells in rows:
        key = ROWS[name]
        values = [everything[key].cost, everything[key].error, *(points[key].error for points in of_kind)]
        for cell, value in zip(cells, values, strict=True):
            assert shows(cell, value), f"{name}: {cell} in the table, {value:.4g} in the records"


def test_table_of_reference_scenes_is_that_of_the_records(shown_study: list[Record]):
    of = {(record["scene"], setting_key(record)): record for record in shown_study}
    header, *rows = table("scene")
    assert header[1:] == list(COLUMNS)
    names = [row[0].split(" ")[0] for row in rows]
    assert set(names) == {record["scene"] for record in shown_study} - set(CLOSED_FORMS)
    for scene, (_, *cells) in zip(names, rows):
        for column, cell in zip(COLUMNS, cells, strict=True):
            record = of[scene, COLUMNS[column]]
            said = f"{scene}, {column}: {cell} in the table, {record['error']} in the records"
            assert shows(cell.rstrip("?"), record["error"]), said
            assert cell.endswith("?") != accepted(record), said
