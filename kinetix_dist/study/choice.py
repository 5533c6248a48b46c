"""Arms and seeds of a study that are chosen by name and number, in its file or by an option."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from kinetix_dist.near_names import did_you_mean
from kinetix_dist.sweep.design import DesignError


def check_arms(chosen: Iterable[str], arms: Sequence[str], problem: str) -> None:
    """Raises DesignError for a name that is no arm; problem: what is wrong then, with {name} in it."""
    for name in chosen:
        if name not in arms:
            hint = did_you_mean(name, arms, f"arms are {', '.join(arms)}")
            raise DesignError(f"{problem.format(name=repr(name))}; {hint}")


def number_of_seeds(usual: int, requested: int | None) -> int:
    """Seeds of each arm; requested: by --seeds, None: as many as the study says. Raises DesignError for none."""
    count = usual if requested is None else requested
    if count < 1:
        raise DesignError(f"--seeds is {count}; give 1 or more")
    return count
