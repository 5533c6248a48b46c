"""Solver settings in words: the preset they are, or the preset they come closest to and what differs from it."""

from __future__ import annotations

import dataclasses

from jax2d.settings import PRESETS, Settings


def describe(settings: Settings) -> str:
    """ "standard", or "standard with substeps 8": the preset that fewest fields differ from, the first of equals."""
    changed = {name: _differences(settings, known) for name, known in PRESETS.items()}
    name = min(["standard", *changed], key=lambda preset: len(changed[preset]))
    return f"{name} with {', '.join(changed[name])}" if changed[name] else name


def _differences(settings: Settings, known: Settings) -> list[str]:
    """Fields that differ, as "substeps 8"."""
    names = [field.name for field in dataclasses.fields(settings)]
    return [f"{name} {getattr(settings, name)}" for name in names if getattr(settings, name) != getattr(known, name)]
