"""Studies by name: the files in `studies/` of this package, or a file of your own."""

from __future__ import annotations

from pathlib import Path

from kinetix_dist.near_names import did_you_mean
from kinetix_dist.study.study_file import Study, read_study
from kinetix_dist.sweep.design import DesignError

STUDIES = Path(__file__).parent / "studies"


def study_names() -> list[str]:
    """Names of the studies of the package, sorted."""
    return sorted(file.stem for file in STUDIES.glob("*.toml"))


def find_study(name: str) -> Study:
    """The study of that name, or in that file where the name ends with .toml. Raises DesignError, one line."""
    if name.endswith(".toml"):
        return read_study(Path(name))
    known = study_names()
    if name not in known:
        hint = did_you_mean(name, known, f"studies are {', '.join(known)}, or name a file of your own, NAME.toml")
        raise DesignError(f"unknown study {name!r}; {hint}")
    return read_study(STUDIES / f"{name}.toml")
