"""`kinetix-dist data import-kinetix|export-minari`: data sets of others, in and out.

    kinetix-dist data import-kinetix data/1M/s imported --trajectories 4096     offline data of the public package
    kinetix-dist data export-minari imported kinetix/experts-v0                 a data set for readers of Minari

docs/data.md has both formats.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from kinetix_dist.cli.checks import check_count, check_output_directory, start_computing
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, one_line, user_errors

if TYPE_CHECKING:
    from kinetix_dist.data.shards import Shard

MAX_TRAJECTORIES = 10**9  # the published data have 11.5 million
SHOWN = 3  # trajectories that are left out, whose reasons are printed


@dataclasses.dataclass(frozen=True)
class ImportKinetix:
    """Turn offline data of the public Kinetix package (zarr) into a data set."""

    source: tyro.conf.Positional[Path]
    """A split as it is downloaded, such as data/1M/s: a zarr group of trajectories."""
    out: tyro.conf.Positional[Path]
    """Directory of the data set: a new one, or one of the same command, which goes on."""
    first: int = 0
    """Number of the first trajectory, from 0 on."""
    trajectories: float | None = None
    """Trajectories from there on, each of a level of its own; left out: all that follow."""
    shard_trajectories: int = 256
    """Trajectories of a shard."""
    observation: str = "entity"
    """Observation that the data set holds: entity, entity_kinetix, flat or pixels."""


@dataclasses.dataclass(frozen=True)
class ExportMinari:
    """Turn a data set into one of Minari (HDF5)."""

    data: tyro.conf.Positional[Path]
    """A data set of `kinetix-dist collect` or `data import-kinetix`."""
    id: tyro.conf.Positional[str]
    """Id of the Minari data set, such as kinetix/generalist-v0; below $MINARI_DATASETS_PATH or ~/.minari/datasets."""


Args = (
    Annotated[ImportKinetix, tyro.conf.subcommand("import-kinetix")]
    | Annotated[ExportMinari, tyro.conf.subcommand("export-minari")]
)


def run(args: Any) -> int:
    return _import(args) if isinstance(args, ImportKinetix) else _export(args)


def _import(args: ImportKinetix) -> int:
    for name in ("trajectories", "shard_trajectories"):
        check_count(name, getattr(args, name), MAX_TRAJECTORIES)
    check_output_directory(args.out)
    from kinetix_dist.data import DatasetError
    from kinetix_dist.data.kinetix_import import choose, import_offline
    from kinetix_dist.data.kinetix_offline import KinetixOffline

    start_computing()
    with user_errors(DatasetError, ValueError):
        source = KinetixOffline(args.source)
        if not 0 <= args.first < len(source):
            raise UserError(f"--first is {args.first}, and {args.source} has trajectories 0 to {len(source) - 1}")
        stop = len(source) if args.trajectories is None else min(args.first + int(args.trajectories), len(source))
        chosen = choose(source, args.first, stop, args.observation)
    for line in chosen.left_out[:SHOWN]:
        say(f"left out {one_line(line)}", sys.stderr)
    print(
        f"importing {len(chosen.numbers):,} of {len(source):,} trajectories of {args.source} into {args.out}"
        + (f"; {len(chosen.left_out)} cannot be read" if chosen.left_out else ""),
        flush=True,
    )

    def on_shard(shard: Shard, number: int) -> None:
        print(f"shard {shard.shard + 1} of {number}  {shard.bytes / 1e6:.1f} MB", flush=True)

    try:
        shards = import_offline(source, chosen, args.out, args.shard_trajectories, on_shard)
    except DatasetError as error:
        raise UserError(one_line(error)) from None
    except OSError as error:
        raise UserError(
            f"a shard cannot be written ({one_line(error.strerror or error)}); those before it are whole, and the "
            "same command goes on"
        ) from None
    num_rows, num_bytes = (sum(getattr(shard, name) for shard in shards) for name in ("rows", "bytes"))
    print(
        f"{args.out}: {num_rows:,} transitions in {len(shards)} shards, {num_bytes / num_rows:.1f} bytes a transition"
    )
    return 0


def _export(args: ExportMinari) -> int:
    from kinetix_dist.data import DatasetError, open_dataset
    from kinetix_dist.data.minari_export import export_minari

    start_computing()

    def on_shard(done: int, number: int) -> None:
        print(f"shard {done} of {number}", flush=True)

    with user_errors(DatasetError, OSError):
        data = open_dataset(args.data)
        if data.shortfall:
            say(data.shortfall, sys.stderr)
        folder, num_episodes = export_minari(data, args.id, on_shard)
    print(f"{folder}: {num_episodes:,} episodes, {len(data):,} transitions; minari.load_dataset({args.id!r}) opens it")
    return 0
