"""Named sets of levels, for evaluation and for training on levels that people made.

    levels, names = load_level_set("designed_s")

A name is a designed set of levels/sets.toml, one designed level ("hop_home" or "s/hop_home"), a held-out random set
("random_s" to "random_l", with the distribution of the public Kinetix package "kinetix_s" to "kinetix_l", and cars,
walkers, unicycles and arms "locomotion_s" to "locomotion_l", families of mechanisms "tasks_s" to "tasks_l", and 1,000
levels that begin with those of "random_s" and so on "random_1000_s" to "random_1000_l"), a set to develop with
("dev_random_s", "dev_designed_s", "frontier_s" and so on), or a file or directory of level files, ours or of the public
package.

Published results are measured on held-out and designed sets. Settings, recipes and networks are chosen on sets to
develop with, which share no random level with them, so that published results have no selection bias.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jax2d import after_fork
from jax2d.scene import Array, stack_worlds
from kinetix_dist import prng
from kinetix_dist.level.fingerprints import FINGERPRINT_FILE, check_fingerprint, known_fingerprints
from kinetix_dist.level.fit import LevelSizeError, capacity_of_size, fit_level, smallest_size
from kinetix_dist.level.frontier import FRONTIER_FILE, frontier_levels, frontier_sets
from kinetix_dist.level.generator import generate_filtered
from kinetix_dist.level.generator_config import generator
from kinetix_dist.level.kinetix_format import is_kinetix_document, read_kinetix
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.level_data import VARIED_SETS, designed_files, designed_names, designed_sets, levels_root
from kinetix_dist.level.proof import PROOF_SUFFIX
from kinetix_dist.level.schema import LevelInfo, load_level
from kinetix_dist.level.simulation import noop_solved
from kinetix_dist.level.structure import REMEDY, LevelNote, foreign_files, is_zarr_store
from kinetix_dist.level.validate import LevelFormatError, read_document
from kinetix_dist.level.variants import variants
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.text_files import is_hidden

HELD_OUT_STREAM = 0x48454C44  # "HELD": key of random sets; training folds its own constants into its own seed
HELD_OUT_LEVELS = 256
LONG_HELD_OUT_LEVELS = 1000  # as many as the paper has; the first ones are those of the sets of 256
DEVELOPMENT_STREAM = 0x444556  # "DEV"
DEVELOPMENT_LEVELS = 2048
PUBLIC_SOURCE = "public Kinetix level file"  # `source` of such a level, also after `levels import`


@dataclasses.dataclass(frozen=True, kw_only=True)
class RandomSet:
    """Random levels of a size that are not trained on."""

    name: str
    size: str
    generator: str  # of GENERATORS
    stream: int = HELD_OUT_STREAM  # key of it
    num_levels: int = HELD_OUT_LEVELS


RANDOM_SETS = (
    {
        f"{prefix}_{size}": RandomSet(name=f"{prefix}_{size}", size=size, generator=generator)
        for prefix, generator in {
            "random": "default",
            "kinetix": "kinetix",
            "locomotion": "locomotion",
            "tasks": "tasks",
        }.items()
        for size in SIZES
    }
    | {
        f"dev_random_{size}": RandomSet(
            name=f"dev_random_{size}",
            size=size,
            generator="default",
            stream=DEVELOPMENT_STREAM,
            num_levels=DEVELOPMENT_LEVELS,
        )
        for size in SIZES
    }
    | {
        f"random_1000_{size}": RandomSet(
            name=f"random_1000_{size}", size=size, generator="default", num_levels=LONG_HELD_OUT_LEVELS
        )
        for size in SIZES
    }
)


def development_sets() -> tuple[str, ...]:
    """Names of the sets by which settings may be chosen."""
    drawn = [name for name, random_set in RANDOM_SETS.items() if random_set.stream == DEVELOPMENT_STREAM]
    return (*drawn, *VARIED_SETS, *frontier_sets())


def load_level_set(
    name: str,
    size: str | None = None,
    *,
    num_levels: int | None = None,
    noop_outcome_fn: Callable[[Level], Array] = noop_solved,
) -> tuple[Level, list[str]]:
    """A batch of levels and their names, in arrays of `size` (default: the smallest that fits all of them).

    `num_levels` and `noop_outcome_fn` are for random sets: how many (None: all), and which solve themselves. Raises
    `ValueError` (`LevelFormatError`, `LevelSizeError`) or `FileNotFoundError`, one line each.
    """
    after_fork.check()
    if size is not None:
        capacity_of_size(size)
    if num_levels is not None and name not in RANDOM_SETS:
        raise ValueError(f"num_levels is {num_levels}, but {name!r} is no random set; leave num_levels out")
    if name in RANDOM_SETS:
        drawn = RANDOM_SETS[name]
        return _random_set(drawn, size, drawn.num_levels if num_levels is None else num_levels, noop_outcome_fn)
    if name in VARIED_SETS:
        levels, names = _stack(files_of_set(VARIED_SETS[name]), size)
        levels, names = variants(prng.key(DEVELOPMENT_STREAM), levels, names)
        if size in (None, size_of_drawn_set(name)):  # numbers are drawn for each slot of the arrays
            _check(name, levels)
        return levels, names
    if name in (frontier := frontier_sets()):
        levels, names = frontier_levels(frontier[name])
        if frontier[name].fingerprint:
            check_fingerprint(name, levels, frontier[name].fingerprint)
        return _in_arrays_of(size, frontier[name].size, levels, names)
    return _stack(files_of_set(name), size)


def size_of_drawn_set(name: str) -> str | None:
    """Size ("s", "m" or "l") of the levels of a set that is drawn when it is used; None for sets of files."""
    if name in RANDOM_SETS:
        return RANDOM_SETS[name].size
    if name in VARIED_SETS:
        return name[-1]
    made = frontier_sets().get(name)
    return made.size if made else None


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelFile:
    """Content of a level file of either format."""

    level: Level  # numpy, in arrays of the size the file says
    info: LevelInfo
    document: Any  # of the file's own format
    notes: tuple[str, ...] = ()  # mended walls and ignored settings, a phrase each


def read_level_file(path: Path) -> LevelFile:
    """Raises `LevelFormatError`, `LevelSizeError` or OSError, one line."""
    document = read_document(path)
    if is_kinetix_document(document):
        return _public_file(path, document)
    level, info = load_level(path)
    return LevelFile(level=level, info=info, document=document)


def _public_file(path: Path, document: Any) -> LevelFile:
    try:
        public = read_kinetix(document)
        size = smallest_size(public.level)
    except LevelFormatError as error:
        raise error.in_file(path) from None
    except LevelSizeError as error:
        raise LevelSizeError(f"{path}: {error}") from None
    info = LevelInfo(name=path.stem, size=size, source=PUBLIC_SOURCE, public_walls=public.walls)
    return LevelFile(level=public.level, info=info, document=document, notes=public.notes)


def read_level(path: Path) -> tuple[Level, LevelInfo]:
    """One level of a file in either format, in arrays of the size in the file, and its description. Warns with a
    `LevelNote` of mended walls. Raises as `read_level_file`."""
    return _with_note(path, read_level_file(path))


def read_public_level(path: Path) -> tuple[Level, LevelInfo]:
    """The same of a file of the public package; no other is read."""
    return _with_note(path, _public_file(path, read_document(path)))


def _with_note(path: Path, file: LevelFile) -> tuple[Level, LevelInfo]:
    if file.notes:
        warnings.warn(LevelNote(f"{path}: {'; '.join(file.notes)}"), stacklevel=3)
    return file.level, file.info


def is_public_level(path: Path) -> bool:
    """True of a level file of the public package, or imported from one. Raises as `read_level`."""
    document = read_document(path)
    return is_kinetix_document(document) or document.get("source") == PUBLIC_SOURCE


def files_of_set(name: str) -> list[Path]:
    """The level files of a designed set, a designed level, a file or a directory.

    Raises ValueError for a set that is drawn and for an unknown name, FileNotFoundError for a path that does not exist
    and for an empty directory.
    """
    if size_of_drawn_set(name):
        raise ValueError(f"{name!r} is drawn when it is used; it has no files; name a designed set or level files")
    sets = designed_sets()
    if name in sets:
        return [levels_root() / file for file in sets[name]["levels"]]
    if found := designed_files(name):
        if len(found) > 1:
            raise ValueError(f"level {name!r} is in more than one size; name one of {', '.join(map(str, found))}")
        return found
    path = Path(name)
    if path.is_file():
        return [path]
    if path.is_dir():
        files = level_files(path, "*.json") or level_files(path, "*/*.json")
        if not files:
            raise FileNotFoundError(f"no .json level files in {path}; give a directory of them{foreign_files(path)}")
        return files
    if path.suffix or path.is_absolute():
        raise FileNotFoundError(f"there is no level file or directory {name}")
    known = [*sets, *VARIED_SETS, *RANDOM_SETS, *frontier_sets()]
    known_sets = f"sets are {', '.join(known)}, or give a level file or a directory of them"
    hint = did_you_mean(name, [*known, *designed_names()], known_sets)
    raise ValueError(f"unknown level set {name!r}; {hint}")


def level_names(files: Sequence[Path]) -> list[str]:
    """Return a name for each file that no other file of the sequence has.

    The name is the stem, "same"; of files with equal stems it is the path below their common directory, "m/same".
    """
    stems = Counter(file.stem for file in files)
    common = Path(os.path.commonpath([file.parent for file in files]))
    return [
        file.stem if stems[file.stem] == 1 else file.relative_to(common).with_suffix("").as_posix() for file in files
    ]


def level_files(directory: Path, pattern: str) -> list[Path]:
    """Files of a directory that should hold levels: not proofs in the same directory, and not other level data."""
    return [path for path in data_files(directory, pattern) if not path.name.endswith(PROOF_SUFFIX)]


def data_files(directory: Path, pattern: str) -> list[Path]:
    """Files of a directory that should hold levels or proofs: all but hidden ones and those of the level data that
    describe them. Raises LevelFormatError for a store of another format."""
    if is_zarr_store(directory):
        raise LevelFormatError(str(directory), "is a zarr store of arrays", REMEDY)
    found = sorted(path for path in directory.glob(pattern) if path.is_file() and not is_hidden(path, directory))
    return [path for path in found if path.name not in ("schema.json", FRONTIER_FILE, FINGERPRINT_FILE)]


def file_of_level(name: str) -> Path:
    """The file of one level. Raises as `files_of_set`, and ValueError for several."""
    files = files_of_set(name)
    if len(files) != 1:
        raise ValueError(f"{name!r} is a set of {len(files)} levels; name one level")
    return files[0]


def held_out_key(size: str, stream: int = HELD_OUT_STREAM) -> Array:
    """Key of the random levels of one size that are not trained on."""
    return prng.fold_in(prng.key(stream), list(SIZES).index(size))


def _random_set(
    drawn: RandomSet, size: str | None, num_levels: int, noop_outcome_fn: Callable[[Level], Array]
) -> tuple[Level, list[str]]:
    config = generator(drawn.generator)
    levels = generate_filtered(held_out_key(drawn.size, drawn.stream), num_levels, drawn.size, config, noop_outcome_fn)
    levels = jax.tree.map(np.asarray, levels)
    if noop_outcome_fn is noop_solved:  # else other levels are left out
        _check(drawn.name, levels)
    return _in_arrays_of(size, drawn.size, levels, [f"{drawn.name}_{i}" for i in range(num_levels)])


def _check(name: str, levels: Level) -> None:
    known = known_fingerprints()
    if name in known:
        check_fingerprint(name, levels, known[name])


def _in_arrays_of(size: str | None, own_size: str, levels: Level, names: list[str]) -> tuple[Level, list[str]]:
    """The same levels in arrays of another size."""
    if size is None or size == own_size:
        return levels, names
    singles = [jax.tree.map(lambda x, i=i: x[i], levels) for i in range(len(names))]
    return stack_worlds([fit_level(level, capacity_of_size(size)) for level in singles]), names


def _stack(files: Sequence[Path], size: str | None) -> tuple[Level, list[str]]:
    levels = [read_level(file)[0] for file in files]
    if size is None:
        order = list(SIZES)
        size = max((smallest_size(level) for level in levels), key=order.index)
    fitted = []
    for file, level in zip(files, levels):
        try:
            fitted.append(fit_level(level, capacity_of_size(size)))
        except LevelSizeError as error:
            raise LevelSizeError(f"{file}: {error}") from None
    return stack_worlds(fitted), level_names(files)
