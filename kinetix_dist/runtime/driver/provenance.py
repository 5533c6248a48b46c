"""What made a checkpoint: versions of the packages that compute, and on what devices. Checkpoints and reports hold it.

A run that is resumed elsewhere goes on, but its numbers are no longer bit for bit those of the unbroken run: other
versions compile other programs, and another number of devices adds up in another order.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_PACKAGES = ("kinetix-dist", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "warp-lang", "ray", "numpy")
_COMPUTE_NOTHING = ("orbax-checkpoint", "ray")
# Placements "local" and "colocated" run the same programs: same bits (split is told apart by the config hash).
_MAKES_NO_DIFFERENCE = ("placement",)


@functools.cache
def versions() -> dict[str, str]:
    """Of Python, of the packages that a run uses, and of the engine."""
    found = {"python": platform.python_version(), "engine": engine_revision()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


@functools.cache
def engine_revision() -> str:
    """12 hexadecimal digits over the sources of the engine: the version of a checkout says little about its code."""
    return _revision("jax2d")


@functools.cache
def versions_and_code() -> dict[str, str]:
    """`versions`, and the same digits for the rest of the code: what all nodes of a run have to agree on."""
    return {**versions(), "code": _revision("kinetix_dist")}


def _revision(package: str) -> str:
    """Over the sources of a package, which is found without importing it."""
    found = importlib.util.find_spec(package)
    assert found is not None and found.origin is not None
    root = Path(found.origin).parent
    digest = hashlib.sha256()
    for path in sorted((*root.rglob("*.py"), *root.rglob("*.h"))):
        digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def what_differs(description: Mapping[str, Any], topology: Mapping[str, Any]) -> list[str]:
    """What computes now and did not make the checkpoint so described: "devices 2 instead of 4", most telling first.

    Empty where the same devices and versions go on, and for checkpoints of before these were kept.
    """
    now = {name: version for name, version in versions().items() if name not in _COMPUTE_NOTHING}
    pairs = ((topology, description.get("topology", {})), (now, description.get("versions", {})))
    return [
        f"{name} {ours[name]} instead of {theirs[name]}"
        for ours, theirs in pairs
        for name in ours
        if name in theirs and name not in _MAKES_NO_DIFFERENCE and ours[name] != theirs[name]
    ]
