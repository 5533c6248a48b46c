"""Arms and seeds of a study that are chosen by name and number, and seeds of the runs in a directory of results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from kinetix_dist.near_names import did_you_mean
from kinetix_dist.number_ranges import MAX_SEEDS
from kinetix_dist.sweep.design import DesignError
from kinetix_dist.sweep.results_directory import ARMS


def check_arms(chosen: Iterable[str], arms: Sequence[str], problem: str) -> None:
    """Raise DesignError for an unknown name. problem: words for it, with {name} in them."""
    for name in chosen:
        if name not in arms:
            hint = did_you_mean(name, arms, f"arms are {', '.join(arms)}")
            raise DesignError(f"{problem.format(name=repr(name))}; {hint}")


def seeds_to_run(first: int, usual: int, requested: int | None) -> range:
    """Return the seeds of each arm.

    Args:
        first: The first of them.
        usual: Their number in the study.
        requested: Their number in --seeds, or None without the option.

    Raises:
        DesignError: Their number is below 1 or above `MAX_SEEDS`.
    """
    count = usual if requested is None else requested
    option = "seeds of the study" if requested is None else "--seeds"
    if count < 1:
        raise DesignError(f"{option} is {count}; give 1 or more")
    if count > MAX_SEEDS:
        raise DesignError(f"{option} is {count:,}; give {MAX_SEEDS:,} or fewer")
    return range(first, first + count)


def seeds_in(path: Path | None) -> set[int]:
    """Return the seeds of the runs ARM-seedN and ARM-seedN-partK in a directory of results, if there is one."""
    folders = [] if path is None else (path / ARMS).glob("*-seed*")
    ends = [folder.name.rpartition("-seed")[2].partition("-")[0] for folder in folders]
    return {int(end) for end in ends if end.isdecimal()}
