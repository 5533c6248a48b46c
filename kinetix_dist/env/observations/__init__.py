"""Observations by name, `EnvConfig.observation`. One file each, with the same three methods (`observation.py`)."""

from __future__ import annotations

from kinetix_dist.env.observations.entities import EntityObservation
from kinetix_dist.env.observations.flat import FlatObservation
from kinetix_dist.env.observations.kinetix_entities import KinetixEntityObservation
from kinetix_dist.env.observations.observation import ENTITIES, IMAGE, VECTOR, Moving, Observation
from kinetix_dist.env.observations.pixels import PixelObservation
from kinetix_dist.registry import Registry

__all__ = [
    "ENTITIES",
    "IMAGE",
    "OBSERVATIONS",
    "VECTOR",
    "EntityObservation",
    "FlatObservation",
    "KinetixEntityObservation",
    "Moving",
    "Observation",
    "PixelObservation",
]

OBSERVATIONS: Registry[Observation] = Registry("observation")
OBSERVATIONS.register("entity", EntityObservation())
OBSERVATIONS.register("flat", FlatObservation())
OBSERVATIONS.register("entity_kinetix", KinetixEntityObservation())
OBSERVATIONS.register("pixels", PixelObservation())
