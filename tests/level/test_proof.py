"""Proof files: what is written comes back, and a proof of something else is refused in one line."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kinetix_dist.level.proof import Proof, check_proof_is_of, level_hash, proof_path, read_proof, write_proof
from kinetix_dist.level.validate import LevelFormatError
from tests.level.documents import cart_document

ACTIONS = np.repeat(
    np.array([[1, 0, 2, 0, 0, 1], [0, 0, 0, 0, 0, 0], [1, 0, 2, 0, 0, 1]], np.int32), [12, 1, 3], axis=0
)
PROOF = Proof(
    level="cart",
    level_sha256=level_hash(cart_document()),
    preset="standard",
    frame_skip=2,
    max_steps=256,
    action_space="multi_discrete",
    actions=ACTIONS,
    method="cem",
    robustness=0.5,
)
ENVIRONMENT: dict[str, Any] = {"preset": "standard", "frame_skip": 2, "max_steps": 256}


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    write_proof(tmp_path / "new" / "cart.json", PROOF)
    back = read_proof(tmp_path / "new" / "cart.json")
    np.testing.assert_array_equal(back.actions, ACTIONS)
    assert back.actions.dtype == np.int32 and back.num_steps == 16
    fields = [field.name for field in dataclasses.fields(Proof) if field.name != "actions"]
    assert [getattr(back, name) for name in fields] == [getattr(PROOF, name) for name in fields]
    written = json.loads((tmp_path / "new" / "cart.json").read_text())
    assert written["actions"] == "12*102001 1*000000 3*102001"


def test_the_hash_is_that_of_what_moves() -> None:
    document = cart_document()
    for about in ("title", "description", "name", "difficulty"):
        assert level_hash(document | {about: "another"}) == PROOF.level_sha256
    document["shapes"][0]["position"][0] += 1e-6
    assert level_hash(document) != PROOF.level_sha256
    assert level_hash(cart_document() | {"gravity": [0, -9.8]}) != PROOF.level_sha256


def test_a_proof_of_another_level_or_environment_is_refused() -> None:
    path = Path("cart.json")
    check_proof_is_of(PROOF, path, cart_document(), **ENVIRONMENT)
    with pytest.raises(
        LevelFormatError, match=r"^cart.json: level_sha256: is [0-9a-f]{12}\.\.\., the level is .*again"
    ):
        check_proof_is_of(PROOF, path, cart_document() | {"gravity": [0, 0]}, **ENVIRONMENT)
    with pytest.raises(LevelFormatError, match=r"^cart.json: preset: is 'standard', requested is 'fine'; use"):
        check_proof_is_of(PROOF, path, cart_document(), **ENVIRONMENT | {"preset": "fine"})
    with pytest.raises(LevelFormatError, match="frame_skip: is 2, requested is 4"):
        check_proof_is_of(PROOF, path, cart_document(), **ENVIRONMENT | {"frame_skip": 4})


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"actions": "12*102003"}, r"cart.json: actions: '12\*102003' does not match"),
        ({"actions": "0*102001"}, "cart.json: actions: .*does not match"),
        ({"num_steps": 15}, "cart.json: actions: are 16 steps, num_steps is 15; find the proof again"),
        ({"max_steps": 15}, "cart.json: num_steps: is 16, an episode has 15; find a shorter proof"),
        ({"action_space": "continuous"}, "cart.json: action_space: is 'continuous'; use 'multi_discrete'"),
        ({"level_sha256": "abc"}, "cart.json: level_sha256: 'abc' does not match"),
        ({"author": "me"}, "cart.json: author: is not a field of the format"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, change: dict[str, object], complaint: str) -> None:
    path = tmp_path / "cart.json"
    write_proof(path, PROOF)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(LevelFormatError, match=complaint) as refusal:
        read_proof(path)
    assert "\n" not in str(refusal.value)


def test_proofs_of_designed_levels_lie_apart_and_those_of_others_beside_their_level(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "levels").mkdir()
    (tmp_path / "levels" / "schema.json").write_text("{}")
    monkeypatch.setenv("KINETIX_DIST_LEVELS", str(tmp_path / "levels"))
    assert proof_path(tmp_path / "levels/s/a.json") == tmp_path / "levels/proofs/s/a.json"
    assert proof_path(tmp_path / "mine/a.json") == tmp_path / "mine/a.proof.json"
