"""Configuration of a run that a request names by its directory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kinetix_dist.errors import one_line
from kinetix_dist.studio.worker.wire import BAD_REQUEST, NOT_FOUND, RequestError
from kinetix_dist.text_files import read_json


def config_of_run(given: Any, field: str) -> tuple[Path, dict[str, Any]]:
    """config.json of a run, and its stored configuration as it was written. Raises RequestError.

    field: name of the request's field, for the error.
    """
    if not isinstance(given, str) or not Path(given).is_absolute():
        raise RequestError(BAD_REQUEST, f"{field} is {given!r}; give an absolute path")
    path = Path(given) / "config.json"
    try:
        data = read_json(path)
    except OSError as error:
        raise RequestError(NOT_FOUND, f"{path} cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise RequestError(BAD_REQUEST, f"{path} is not JSON ({one_line(error)})") from error
    if not isinstance(data, dict) or not isinstance(data.get("config"), dict):
        raise RequestError(BAD_REQUEST, f"{path} is of no run: it has no object `config`")
    return path, data["config"]
