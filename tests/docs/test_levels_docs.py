"""docs/levels.md: its tables are what the levels and proofs say, and it names every field of a proof."""

from __future__ import annotations

import json

from kinetix_dist.evaluation.search.solve import METHODS
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import proof_path, read_proof
from kinetix_dist.level.schema import load_level
from kinetix_dist.level.sets import files_of_set
from tests.helpers import REPOSITORY

PAGE = (REPOSITORY / "docs" / "levels.md").read_text(encoding="utf-8")
MAX_PICTURE_BYTES = 400_000


def test_the_gallery_is_the_collection() -> None:
    """A row for each level, in the order of its set, with title, difficulty and length of the proof."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("|")]
    shown = [row[:4] for row in rows if len(row) >= 4 and row[2] in ("easy", "medium", "hard")]
    expected = []
    for size in SIZES:
        for file in files_of_set(f"all_designed_{size}"):
            info = load_level(file)[1]
            steps = read_proof(proof_path(file)).num_steps
            expected.append([f"`{info.name}`", info.title, info.difficulty, str(steps)])
    assert shown == expected


def test_there_is_a_small_picture_of_each_size() -> None:
    for size in SIZES:
        name = f"images/designed_{size}.png"
        assert f"]({name})" in PAGE
        assert 10_000 < (REPOSITORY / "docs" / name).stat().st_size < MAX_PICTURE_BYTES


def test_every_field_of_a_proof_and_every_method_is_described() -> None:
    schema = json.loads((levels_root() / "proofs" / "schema.json").read_text(encoding="utf-8"))
    missing = [name for name in (*schema["properties"], *METHODS) if f"`{name}`" not in PAGE]
    assert not missing
