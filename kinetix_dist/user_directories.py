"""Directories of the user that commands write to, and a temporary one where there is none.

Containers run as users without an entry in the password file, without HOME, or with one that cannot be written. JAX,
Warp, Ray and this project all look for caches below HOME: `settle` sets the variables that they read, once, before any
of them is imported. Child processes inherit these.
"""

from __future__ import annotations

import functools
import getpass
import os
import stat
import tempfile
from pathlib import Path

_OURS_ALONE = 0o700


def cache_directory() -> Path:
    """Directory of this project's caches in that of the user."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kinetix-dist"


@functools.cache
def settle() -> str:
    """Makes HOME, XDG_CACHE_HOME and LOGNAME usable, once a process. Returns one line that says what was replaced;
    empty: nothing."""
    try:
        getpass.getuser()
    except (KeyError, OSError):  # no name in the environment, no entry in the password file
        os.environ["LOGNAME"] = f"uid{os.getuid()}"
    home = Path(os.path.expanduser("~"))
    has_home = home.is_absolute() and home.is_dir()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    token = home / ".ray" / "auth_token"  # Ray makes one
    has_cache = has_home and can_be_written(cache)
    has_token = not has_home or token.exists() or can_be_written(token) or bool(os.environ.get("RAY_AUTH_TOKEN_PATH"))
    if has_cache and has_token:
        return ""
    instead = _directory_of_user()
    if not has_token:
        os.environ["RAY_AUTH_TOKEN_PATH"] = str(instead / "ray_auth_token")
    if has_cache:
        return f"{token.parent} cannot be written: Ray's token goes to {instead}; set RAY_AUTH_TOKEN_PATH to move it"
    if not has_home:
        os.environ["HOME"] = str(instead)
    if not cache.is_absolute() or not can_be_written(cache):
        os.environ["XDG_CACHE_HOME"] = str(instead / ".cache")
    why = f"{cache} cannot be written" if has_home else f"user {getpass.getuser()} has no home directory"
    return f"{why}: caches are stored in {instead}; set HOME or XDG_CACHE_HOME to store them elsewhere"


def can_be_written(path: Path) -> bool:
    """True where a file or directory can be changed, or made where it is missing. Nothing is made."""
    for there in (path, *path.parents):
        if there.exists():
            return os.access(there, os.W_OK)
    return False


def _directory_of_user() -> Path:
    """A directory below the one for temporary files, the same for all commands of a user and readable by no other."""
    path = Path(tempfile.gettempdir()) / f"kinetix-dist-{os.getuid()}"
    try:
        path.mkdir(mode=_OURS_ALONE, exist_ok=True)
        found = path.lstat()
    except OSError:
        found = None
    if found is None or not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        return Path(tempfile.mkdtemp(prefix="kinetix-dist-"))  # the name is another user's
    return path
