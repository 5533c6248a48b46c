"""Records of the study: one measurement each, and the name of its setting."""

from __future__ import annotations

import math
from typing import TypedDict

from jax2d.settings import PRESETS, Settings


class Record(TypedDict):
    """One measurement, as it stands in the JSON file."""

    scene: str
    preset: str  # the preset whose settings were swept, or the name of a peer
    backend: str
    dtype: str
    device: str
    setting: str
    metric: str  # what the error is; says so where it is not accepted
    error: float | None  # None: the trajectory is not finite
    us_per_world_second: float


def setting_label(settings: Settings) -> str:
    """Name of the swept part of the settings."""
    count = f"{settings.substeps} substeps" if settings.solver == "soft_step" else f"{settings.substeps} iterations"
    label = f"dt 1/{round(1 / settings.dt)}, {count}"
    if settings.solver == "soft_step" and not math.isclose(settings.contact_hertz, Settings().contact_hertz):
        label += f", contacts to {settings.contact_hertz:g} Hz"
    if not settings.warm_start:
        label += ", no warm start"
    return label


def is_preset_itself(record: Record) -> bool:
    """Returns True if a record's setting is that of its preset, unswept."""
    name = record["preset"]
    return name in PRESETS and setting_label(PRESETS[name]) == record["setting"]
