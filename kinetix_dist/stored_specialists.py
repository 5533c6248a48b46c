"""Results of `kinetix-dist finetune --each` on disk, and the policy a level that they are together.

    OUT/design.json                     settings and checksums of levels, which all specialists share
    OUT/scratch/hop_home.json           one specialist: its curve, final rate, seconds (finetune/results.py)
    OUT/scratch/hop_home.md             its card
    OUT/scratch/hop_home/               its policy, a checkpoint of parameters
    OUT/scratch-seed-3/hop_home.json    the same with `--seeds`

    chosen = specialists_of(Path("runs/experts"), levels, names, min_rate=0.65)
    chosen.by_level[i]                  specialists of level i, which take turns
    players = chosen.players(env, levels)

A level with several seeds is played by those whose final rate is `min_rate` or more, in turns. That is how the
public benchmark of RTC collects its data (generate_data.py: a random one of the experts above 0.65 an episode).
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist.checkpoint import flatten_arrays, unflatten_arrays
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import UserError
from kinetix_dist.evaluation.load_policy import released_arrays
from kinetix_dist.evaluation.policies import Player
from kinetix_dist.json_text import json_text
from kinetix_dist.level.fingerprints import is_in_order
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.text_files import read_json, read_json_object
from kinetix_dist.trained_policy import DESIGN_NAME, Trained, checkpoint_at

FORMAT = 1
FROM_SCRATCH = "scratch"
MIN_RATE = 0.65  # of the public benchmark of RTC

Record = dict[str, Any]
_OF_A_DESIGN: dict[str, type] = {"levels": dict}  # what a file has to have to be read
_OF_A_SPECIALIST: dict[str, type] = {
    "level": str,
    "start": str,
    "label": str,
    "env_steps_to": dict,
    "final": dict,
    "seconds": dict,
    "curve": list,
}


def folder_of(start: str, seed: int | None) -> str:
    """Name of the directory of specialists of one start; seed None: there is one seed."""
    return start if seed is None else f"{start}-seed-{seed}"


def file_name_of(level: str) -> str:
    """Return the name of the files of a level, without a suffix: "m/same", one of two levels "same", has no folder."""
    return level.replace("/", "%2F")


def policy_path(path: Path, record: Record) -> Path:
    """Checkpoint of a specialist in the results at `path`."""
    return path / record["folder"] / file_name_of(record["level"])


def read_results(path: Path) -> list[Record]:
    """All that is stored in a directory, each with its "seed" and the name of its "folder".

    Starts come in order, from scratch first, then seeds, and levels in the order of the design. Raises UserError where
    there is nothing."""
    if not (path / DESIGN_NAME).is_file():
        raise UserError(f"{path} holds no results of specialists (no {DESIGN_NAME}); give a directory that has them")
    levels = list(read_stored(path / DESIGN_NAME)["levels"])
    names = {f"{file_name_of(level)}.json" for level in levels}
    files = [file for file in path.glob("*/*.json") if file.name in names]
    records = [{"seed": 0} | read_stored(file) | {"folder": file.parent.name} for file in files]
    if not records:
        raise UserError(f"{path} holds no finished specialist yet")
    return sorted(
        records,
        key=lambda one: (one["start"] != FROM_SCRATCH, one["start"], one["seed"], levels.index(one["level"])),
    )


def best_of_levels(records: Sequence[Record]) -> list[Record]:
    """Record with the highest final rate of each level, the first of equals."""
    levels = dict.fromkeys(record["level"] for record in records)
    return [
        max((record for record in records if record["level"] == level), key=lambda record: record["final"]["rate"])
        for level in levels
    ]


def read_stored(file: Path) -> Record:
    """A design, or a specialist. Raises UserError, one line, for a file that is damaged."""
    is_design = file.name == DESIGN_NAME
    advice = "choose another directory" if is_design else "remove it, and its specialist is trained again"
    content = read_json_object(file, advice=advice)
    for name, expected in (_OF_A_DESIGN if is_design else _OF_A_SPECIALIST).items():
        if not isinstance(content.get(name), expected):
            raise UserError(f"{file} is damaged: {name!r} is missing or of another type; {advice}")
    return content


def level_set_of(path: Path) -> str:
    """Return the name or path of the levels that a results directory was made from. Raises UserError without one."""
    file = path / DESIGN_NAME
    curriculum = read_stored(file).get("curriculum")
    levels = curriculum.get("levels") if isinstance(curriculum, dict) else None
    if not isinstance(levels, str):
        raise UserError(f"{file} is damaged: it does not name its levels; choose another directory")
    return levels


def digest_of(level: Level) -> str:
    """Digest of all numbers of a level."""
    digest = hashlib.sha256()
    for name, array in sorted(flatten_arrays(level).items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def are_specialists(path: Path) -> bool:
    """True for a directory that `finetune --each` wrote, or a start or a seed in one."""
    return _root_of(path) is not None


def _root_of(path: Path) -> Path | None:
    for root in (path, path.parent):
        try:
            if "levels" in read_json(root / DESIGN_NAME):
                return root
        except (OSError, ValueError, TypeError):
            continue
    return None


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredSpecialist:
    """Specialist of a level with its policy."""

    level: str
    seed: int
    rate: float  # at the end of its training
    trained: Trained

    @property
    def sha256(self) -> str:
        """Of the parameters that play, by name."""
        return digest_of_arrays(released_arrays(self.trained.checkpoint))


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredSpecialists:
    """Specialists of levels, which play them together as one policy."""

    path: Path
    min_rate: float
    by_level: tuple[tuple[StoredSpecialist, ...], ...]  # [L]; those of a level take turns
    left_out: tuple[str, ...]  # a line for each seed below the rate

    @property
    def first(self) -> Trained:
        """One of them: environment and network are those of all."""
        return self.by_level[0][0].trained

    @property
    def description(self) -> Record:
        """Policy of the manifest of a data set, where those of a level take turns in this order."""
        own = {
            specialists[0].level: [
                {"seed": one.seed, "version": one.trained.num_updates, "rate": one.rate, "sha256": one.sha256}
                for one in specialists
            ]
            for specialists in self.by_level
        }
        return {
            "name": self.path.name,
            "version": max(one["version"] for specialists in own.values() for one in specialists),
            "sha256": hashlib.sha256(json_text(own, sort_keys=True).encode()).hexdigest(),
            "min_rate": self.min_rate,
            "specialists": own,
        }

    def players(self, env: Environment, levels: Level, *, greedy: bool = False) -> list[list[Player]]:
        """Player of each, by level. Raises UserError where they do not fit levels of this size."""
        one = self.first.player(env, levels, greedy=greedy)

        def player(specialist: StoredSpecialist) -> Player:
            arrays = unflatten_arrays(one.params, released_arrays(specialist.trained.checkpoint))
            return Player(one.policy, jax.tree.map(jnp.asarray, arrays))

        return [[player(specialist) for specialist in own] for own in self.by_level]


def specialists_of(
    path: Path, levels: Level, names: Sequence[str], *, min_rate: float | None = None
) -> StoredSpecialists:
    """Specialists of levels [L, ...] that solve `min_rate` (None: `MIN_RATE`) of their level or more.

    path: results of `finetune --each`, or one start or seed in them, such as runs/experts/scratch-seed-3. A level is
    compared with the one that was trained on where both are in arrays of one size. Raises UserError, one line, for a
    level without a specialist, for one that changed, for specialists of several starts and for damaged ones.
    """
    min_rate = MIN_RATE if min_rate is None else min_rate
    root = _root_of(path)
    if root is None:
        raise UserError(f"{path} holds no results of specialists (no {DESIGN_NAME}); give a directory that has them")
    records = [one for one in read_results(root) if path == root or path.name in (one["start"], one["folder"])]
    if len(starts := list(dict.fromkeys(record["start"] for record in records))) > 1:
        raise UserError(
            f"{path} has specialists from {starts[0]} and from {starts[1]}; give {root / starts[0]}, or the other"
        )
    by_level: dict[str, list[Record]] = {name: [] for name in names}
    for record in records:
        by_level.setdefault(record["level"], []).append(record)
    if missing := [name for name in names if not by_level[name]]:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise UserError(
            f"{path} has no specialist of level {missing[0]!r}{more}; train it by the same command, or leave it out"
        )
    _check_levels(root, levels, names, by_level)
    return StoredSpecialists(
        path=path,
        min_rate=min_rate,
        by_level=tuple(tuple(map(_loader(root), _good(by_level[name], min_rate))) for name in names),
        left_out=tuple(
            f"{name} seed {record['seed']} solves {record['final']['rate']:.0%}, less than --min-rate {min_rate:g}"
            for name in names
            for record in by_level[name]
            if record["final"]["rate"] < min_rate
        ),
    )


def _good(records: Sequence[Record], min_rate: float) -> list[Record]:
    good = [record for record in records if record["final"]["rate"] >= min_rate]
    if not good:
        best = max(records, key=lambda record: record["final"]["rate"])
        raise UserError(
            f"no specialist of level {best['level']!r} solves {min_rate:.0%} of its attempts (the best "
            f"{best['final']['rate']:.0%}, seed {best['seed']}); train longer or with more seeds, lower --min-rate, or "
            "leave the level out"
        )
    return good


def _loader(root: Path) -> Any:
    def load(record: Record) -> StoredSpecialist:
        file = policy_path(root, record)
        try:
            trained = checkpoint_at(file)
        except UserError as error:
            raise UserError(f"{error}; remove {file}.json, and its specialist is trained again") from None
        return StoredSpecialist(
            level=record["level"], seed=record["seed"], rate=record["final"]["rate"], trained=trained
        )

    return load


def _check_levels(root: Path, levels: Level, names: Sequence[str], by_level: Mapping[str, list[Record]]) -> None:
    """Raises UserError for a level that is another than was trained on, where both are of one size."""
    design = read_stored(root / DESIGN_NAME)
    size = next(name for name, known in SIZES.items() if known == capacity_of(levels))
    if design.get("env", {}).get("size") != size:
        return
    for number, name in enumerate(names):
        level = jax.tree.map(lambda x, i=number: np.asarray(x)[i : i + 1], levels)
        for record in by_level[name]:
            if "fingerprint" in record and not is_in_order(level, record["fingerprint"]):
                raise UserError(
                    f"level {name!r} is not the one that its specialists in {root} were trained on; give that one, or "
                    "train on this one"
                )


def digest_of_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over arrays, by name."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(name.encode() + array.tobytes())
    return digest.hexdigest()
