"""Studies by name: the files in `studies/` of this package, or a file of your own.

A file with a `command` is a study of commands (`command_file.py`), any other one of training (`study_file.py`).
"""

from __future__ import annotations

from pathlib import Path

from kinetix_dist.config import ConfigError, build
from kinetix_dist.errors import one_line
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.study.command_file import CommandStudy
from kinetix_dist.study.study_file import Study
from kinetix_dist.sweep.design import DesignError
from kinetix_dist.text_files import read_toml

STUDIES = Path(__file__).parent / "studies"


def study_names() -> list[str]:
    """Names of the studies of the package, sorted."""
    return sorted(file.stem for file in STUDIES.glob("*.toml"))


def find_study(name: str) -> Study | CommandStudy:
    """The study of that name, or in that file where the name ends with .toml. Raises DesignError, one line."""
    if name.endswith(".toml"):
        return read_study(Path(name))
    known = study_names()
    if name not in known:
        hint = did_you_mean(name, known, f"studies are {', '.join(known)}, or name a file of your own, NAME.toml")
        raise DesignError(f"unknown study {name!r}; {hint}")
    return read_study(STUDIES / f"{name}.toml")


def read_study(path: Path) -> Study | CommandStudy:
    """Raises DesignError for a file that is no study, one line that names it."""
    try:
        data = read_toml(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else one_line(error)
        raise DesignError(f"{path} cannot be read as a study ({reason})") from error
    try:
        return build(CommandStudy if "command" in data else Study, data)
    except (ConfigError, DesignError) as error:
        raise DesignError(f"{path}: {one_line(error)}") from error
