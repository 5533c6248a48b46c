"""Parameters of the random level generator; defaults are those of the public package."""

from __future__ import annotations

import dataclasses
import math

_CHANCES = (
    "opposite_side_chance", "large_rectangle_chance", "triangle_chance", "fixed_chance", "fixed_low_bias",
    "motor_on_chance", "limits_chance", "fixed_joint_chance", "thruster_aligned_chance", "joined_shape_chance",
    "free_shape_chance", "thruster_chance", "floor_blue_chance", "floor_red_chance",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeneratorConfig:
    """How random levels are drawn. Chances are 0..1, lengths m, angles rad, speeds and powers in engine units."""

    num_proposals: int = 8  # drawn for each addition; the one with the fewest overlaps is kept
    # What is added after green, blue and the forced control
    joined_shape_chance: float = 0.35
    free_shape_chance: float = 0.35  # the rest: nothing
    thruster_chance: float = 0.3
    floor_blue_chance: float = 0.02
    floor_red_chance: float = 0.08
    # Shapes
    max_shape_size: float = 1.0  # m, diameter of the circle a box fits into (before lengthening)
    min_half_extent: float = 0.05  # m
    min_radius: float = 0.1  # m
    circle_size_factor: float = 0.8  # circles are at most this share of max_shape_size across
    large_rectangle_chance: float = 0.3  # one side is lengthened
    large_rectangle_scale: float = 2.0
    triangle_chance: float = 0.0
    opposite_side_chance: float = 0.5  # green starts on one half of the box and blue on the other
    # Fixed shapes (free ones of sizes M and L only: in S everything moves)
    allow_fixed: bool | None = None  # None: where there are more than 3 shapes besides the walls
    fixed_chance: float = 0.02
    fixed_chance_per_mass: float = 4.0  # 1/kg, large shapes are nearly always fixed
    fixed_low_bias: float = 0.6  # fixed green, blue or red shapes are moved to the lower half
    # Joints
    connect_to_fixed_factor: float = 0.05  # weight of a fixed shape as something to join
    min_visibility: float = 0.05  # m by which each of two joined shapes must stick out of the other
    hidden_fine: float = 10.0  # cost, in overlaps, of a shape that does not
    fixed_joint_chance: float = 0.1
    limits_chance: float = 0.4  # between polygons
    limit_max: float = math.pi  # rad, of either limit
    motor_on_chance: float = 0.8
    motor_speed_min: float = 0.4
    motor_speed_max: float = 3.0
    motor_power_min: float = 1.0
    motor_power_max: float = 3.0
    wheel_power_max: float = 1.0  # where one of the two is a circle
    # Thrusters
    thruster_aligned_chance: float = 0.8  # pushes through the centre of mass
    thruster_power_factor: float = 2.0  # times mass times 0.5..2

    def __post_init__(self) -> None:
        for name in _CHANCES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"GeneratorConfig.{name} is {getattr(self, name)}; chances are 0 to 1")
        if self.joined_shape_chance + self.free_shape_chance > 1.0:
            raise ValueError(
                f"joined_shape_chance {self.joined_shape_chance} and free_shape_chance {self.free_shape_chance} "
                "add up to more than 1; lower one"
            )
        if self.floor_blue_chance + self.floor_red_chance > 1.0:
            raise ValueError("floor_blue_chance and floor_red_chance add up to more than 1; lower one")
        if self.num_proposals < 1:
            raise ValueError(f"GeneratorConfig.num_proposals is {self.num_proposals}; draw at least 1")
        smallest = 2.0 * max(self.min_half_extent * math.sqrt(2.0), self.min_radius / self.circle_size_factor)
        if self.max_shape_size < smallest:
            raise ValueError(
                f"GeneratorConfig.max_shape_size is {self.max_shape_size}; the smallest shapes need {smallest:.3g}"
            )
        if self.max_shape_size * self.large_rectangle_scale > 2.5:
            raise ValueError(
                f"shapes of {self.max_shape_size} m lengthened {self.large_rectangle_scale} times do not fit half of "
                "the 5 m box; lower max_shape_size or large_rectangle_scale"
            )
        if self.motor_speed_min > self.motor_speed_max or self.motor_power_min > self.motor_power_max:
            raise ValueError("motor_speed_min and motor_power_min must not be above their maxima")
