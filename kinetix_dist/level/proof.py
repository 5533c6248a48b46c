"""Proofs that levels can be solved: recorded actions as JSON files, tied to one level by its hash.

    proof = read_proof(proof_path(level_file))
    check_proof_is_of(proof, level_file, preset="standard")

levels/proofs/schema.json is the structure of a file. The claim of a proof is checked by replaying it
(`evaluation/proofs.py`); this file only reads and writes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.json_text import json_text
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.structure import LevelFormatError, check_structure, read_document

FORMAT_NAME = "kinetix-dist-proof"
FORMAT_VERSION = 1
PROOF_SUFFIX = ".proof.json"  # of proofs beside a level file of a user
ABOUT = ("name", "title", "description", "source", "tags", "difficulty")  # of a level, without effect on its motion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Proof:
    """Actions that solve a level from its start, `T` environment steps of `A` numbers."""

    level: str  # name
    level_sha256: str  # `level_hash` of the document
    preset: str  # solver settings of the physics
    frame_skip: int  # physics steps in an environment step
    max_steps: int  # environment steps of an episode
    action_space: str
    actions: np.ndarray  # [T, A] int32
    method: str = ""  # search method that found it
    robustness: float | None = None  # share of slightly different starts that the same actions solve

    @property
    def num_steps(self) -> int:
        return len(self.actions)


def level_hash(document: dict[str, Any]) -> str:
    """SHA-256 of the content of a level document of either format; names and descriptions do not count."""
    content = {key: value for key, value in document.items() if key not in ABOUT}
    return hashlib.sha256(json_text(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def proof_path(level_file: Path) -> Path:
    """Return the file of the proof: levels/proofs/SIZE/NAME.json of a designed level, else one next to the level."""
    root = levels_root().resolve()
    file = level_file.resolve()
    if file.is_relative_to(root):
        return root / "proofs" / file.relative_to(root)
    return level_file.with_name(level_file.stem + PROOF_SUFFIX)


def is_proof_document(document: Any) -> bool:
    return isinstance(document, dict) and document.get("format") == FORMAT_NAME


def read_proof(path: Path) -> Proof:
    """The proof of a file. Raises `LevelFormatError` naming file and field, `OSError` where it cannot be read."""
    document = read_document(path)
    try:
        check_structure(document, levels_root() / "proofs" / "schema.json", see="docs/levels.md")
        fields = {key: value for key, value in document.items() if key not in ("format", "version", "num_steps")}
        num_steps, max_steps = document["num_steps"], document["max_steps"]
        if num_steps > max_steps:
            raise LevelFormatError("num_steps", f"is {num_steps}, an episode has {max_steps}", "find a shorter proof")
        proof = Proof(**fields | {"actions": _decode(document["actions"], num_steps)})
    except LevelFormatError as error:
        raise error.in_file(path) from None
    return proof


def write_proof(path: Path, proof: Proof) -> None:
    """Writes a proof, whole or not at all, and its directory; reading it back gives the same actions."""
    document = {
        "format": FORMAT_NAME,
        "version": FORMAT_VERSION,
        **{field.name: getattr(proof, field.name) for field in dataclasses.fields(proof)},
        "num_steps": proof.num_steps,
        "actions": _encode(proof.actions),
    }
    document = {key: value for key, value in document.items() if value not in ("", None)}
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, json_text(document, indent=2).encode() + b"\n")


def check_proof_is_of(
    proof: Proof, path: Path, level_document: dict[str, Any], *, preset: str, frame_skip: int, max_steps: int
) -> None:
    """Raises `LevelFormatError`, one line, where a proof is of another level or of other settings."""
    found = level_hash(level_document)
    if proof.level_sha256 != found:
        raise LevelFormatError(
            f"{path}: level_sha256",
            f"is {proof.level_sha256[:12]}..., the level is {found[:12]}...: the proof is of another level, or of this "
            "one before a change",
            "find it again with `kinetix-dist levels solve`",
        )
    for name, requested in (("preset", preset), ("frame_skip", frame_skip), ("max_steps", max_steps)):
        if getattr(proof, name) != requested:
            raise LevelFormatError(
                f"{path}: {name}",
                f"is {getattr(proof, name)!r}, requested is {requested!r}",
                f"use {getattr(proof, name)!r}, or find a proof of {requested!r} with `kinetix-dist levels solve`",
            )


def _encode(actions: np.ndarray) -> str:
    """Runs of equal actions: "12*100001 3*000000"."""
    words = ("".join(map(str, row)) for row in np.asarray(actions).tolist())
    return " ".join(f"{len(list(run))}*{word}" for word, run in itertools.groupby(words))


def _decode(text: str, num_steps: int) -> np.ndarray:
    """Inverse of `_encode`. Raises `LevelFormatError` before it makes room for another number of steps."""
    runs = [run.split("*") for run in text.split(" ")]
    count = sum(int(count) for count, _ in runs)
    if count != num_steps:
        raise LevelFormatError("actions", f"are {count} steps, num_steps is {num_steps}", "find the proof again")
    return np.concatenate([np.tile([int(digit) for digit in word], (int(count), 1)) for count, word in runs]).astype(
        np.int32
    )
