"""Springs, dampers, ropes and rods as arguments of the scene builder."""

from __future__ import annotations

import dataclasses

from jax2d.given import LARGEST, SceneError, not_negative, number
from jax2d.scene import NO_MAXIMUM_M


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpringOptions:
    """Arguments of an element between two anchors; a length of None: as far as they are apart now."""

    rest_length: float | None = None  # m
    stiffness: float = 0.0  # N/m
    damping: float = 0.0  # N s/m
    min_length: float = 0.0  # m
    max_length: float | None = None  # m; None: none

    def fields(self, apart: float) -> dict[str, float]:
        """Fields of `Springs`; raises SceneError for what cannot be simulated. `apart`: m between the anchors now."""
        values = {name: not_negative(name, getattr(self, name)) for name in ("stiffness", "damping", "min_length")}
        values["rest_length"] = apart if self.rest_length is None else not_negative("rest_length", self.rest_length)
        longest = NO_MAXIMUM_M if self.max_length is None else number("max_length", self.max_length)
        if longest == 0:
            raise SceneError("max_length is 0; anchors that stay in one place are a joint: use add_revolute_joint")
        if not values["min_length"] <= longest <= LARGEST:
            raise SceneError(
                f"min_length {values['min_length']:g} and max_length {longest:g} leave no length; give the smaller "
                "number as min_length, none below 0"
            )
        has_force = values["stiffness"] > 0 or values["damping"] > 0
        if not has_force and values["min_length"] == 0 and self.max_length is None:
            raise SceneError("the spring does nothing; give stiffness, damping, min_length or max_length")
        return values | {"max_length": longest}
