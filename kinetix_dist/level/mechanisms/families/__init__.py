"""Families of mechanisms. Each file registers its own as it is imported; a new file is named here."""

from kinetix_dist.level.mechanisms.families import (
    arms,
    balance,
    cars,
    crossings,
    flips,
    flyers,
    hands,
    pinball,
    walkers,
)

__all__ = ["arms", "balance", "cars", "crossings", "flips", "flyers", "hands", "pinball", "walkers"]
