"""Parameters of the random level generator, and named sets of them: our own, the public package's, mechanisms."""

from __future__ import annotations

import dataclasses
import math

from kinetix_dist.level.mechanisms import FAMILIES
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.setting import check_settings, setting

# Details of the public package that no number expresses. docs/level_format.md, "Random levels", has their effects.
PUBLISHED_DETAILS = (
    "contact_points",  # a proposal costs 1 or 2 for each polygon it overlaps, of its own body too
    "exchanged_anchors",  # whether a joined shape is hidden is judged with each other's anchors
    "wide_margins",  # free boxes keep 0.1 m from walls at least, circles sometimes 0.14 m
    "joined_to_walls",  # where every polygon holds two joints, any is joined, walls too
    "limits_from_zero",  # limits of a hinge count from equal angles of its shapes, not from those at the start
)
MAX_PROPOSALS = 1_000
# Families of level/mechanisms/ that are drawn by default
LOCOMOTION_FAMILIES = ("car", "unicycle", "walker", "arm")
# Families of the held-out sets tasks_s to tasks_l, in the order of their draws: results are published on these sets,
# so a new family is not added here.
TASK_FAMILIES = (
    *LOCOMOTION_FAMILIES,
    "runner",
    "snake",
    "cartpole",
    "flyer",
    "pusher",
    "beam",
    "lander",
    "carrier",
    "jumper",
    "sprinter",
    "thrower",
    "turner",
    "flipper",
    "grasper",
    "reacher",
    "climber",
    "pendulum",
    "ramp",
    "gripper",
    "pinball",
)


def _chance(default: float) -> float:
    return setting(default, minimum=0, maximum=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeneratorConfig:
    """Parameters of random levels. Chances are 0..1, lengths m, angles rad, speeds and powers in engine units."""

    num_proposals: int = setting(
        8, minimum=1, maximum=MAX_PROPOSALS
    )  # drawn for each addition; the one with the fewest overlaps is added
    num_proposals_s: int = setting(
        8, minimum=1, maximum=MAX_PROPOSALS
    )  # the same with at most 3 shapes besides the walls, as in S
    published_details: tuple[str, ...] = ()  # of PUBLISHED_DETAILS
    # What is added after green, blue and the forced control
    joined_shape_chance: float = _chance(0.35)
    free_shape_chance: float = _chance(0.35)  # the rest: nothing
    thruster_chance: float = _chance(0.3)
    floor_blue_chance: float = _chance(0.02)
    floor_red_chance: float = _chance(0.08)
    # Shapes
    max_shape_size: float = setting(1.0, above=0)  # m, diameter of the circle a box fits into (before lengthening)
    min_half_extent: float = setting(0.05, above=0)  # m
    min_radius: float = setting(0.1, above=0)  # m
    circle_size_factor: float = setting(0.8, above=0)  # circles are at most this share of max_shape_size across
    large_rectangle_chance: float = _chance(0.3)  # one side is lengthened
    large_rectangle_scale: float = setting(2.0, above=0)
    triangle_chance: float = _chance(0.0)
    opposite_side_chance: float = setting(
        0.5, minimum=0, maximum=1
    )  # green starts on one half of the box and blue on the other
    # Fixed shapes (free ones of sizes M and L only: in S everything moves)
    allow_fixed: bool | None = None  # None: where there are more than 3 shapes besides the walls
    fixed_chance: float = _chance(0.02)
    fixed_chance_per_mass: float = 4.0  # 1/kg, large shapes are nearly always fixed
    fixed_low_bias: float = setting(
        0.6, minimum=0, maximum=1
    )  # fixed green, blue or red shapes are moved to the lower half
    # Joints
    connect_to_fixed_factor: float = 0.05  # weight of a fixed shape as something to join
    min_visibility: float = 0.05  # m by which each of two joined shapes must stick out of the other
    hidden_fine: float = 10.0  # cost, in overlaps, of a shape that does not
    fixed_joint_chance: float = _chance(0.1)
    min_revolute_joints: int = setting(0, minimum=0)  # that a level has before it gets a fixed joint
    limits_chance: float = _chance(0.4)  # between polygons
    limit_max: float = setting(math.pi, above=0)  # rad, of either limit
    motor_on_chance: float = _chance(0.8)
    forced_motor_on_chance: float = setting(
        1.0, minimum=0, maximum=1
    )  # of the motor that a level gets first: below 1 some have nothing to control
    motor_speed_min: float = 0.4
    motor_speed_max: float = setting(3.0, above=0)
    motor_power_min: float = 1.0
    motor_power_max: float = setting(3.0, above=0)
    wheel_power_max: float = 1.0  # where one of the two is a circle
    # Thrusters
    thruster_aligned_chance: float = _chance(0.8)  # pushes through the centre of mass
    thruster_power_factor: float = 2.0  # times mass times 0.5..2
    # Levels with one mechanism, see `mechanisms/`
    mechanism_share: float = _chance(0.0)  # of the levels; the others are random as above
    mechanism_families: tuple[str, ...] = LOCOMOTION_FAMILIES  # drawn are those for which the size has room
    mechanism_weights: tuple[float, ...] = ()  # of the families, in their order; empty: all are equally likely
    # Levels, of all of these, with other powers, densities, frictions and so on, see `variety.py`
    varied_share: float = _chance(0.0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.joined_shape_chance + self.free_shape_chance > 1.0:
            raise ValueError(
                f"joined_shape_chance {self.joined_shape_chance} and free_shape_chance {self.free_shape_chance} "
                "add up to more than 1; lower one"
            )
        if self.floor_blue_chance + self.floor_red_chance > 1.0:
            raise ValueError("floor_blue_chance and floor_red_chance add up to more than 1; lower one")
        if unknown := [name for name in self.published_details if name not in PUBLISHED_DETAILS]:
            raise ValueError(
                f"GeneratorConfig.published_details has {unknown[0]!r}; there are {', '.join(PUBLISHED_DETAILS)}"
            )
        if unknown := [name for name in self.mechanism_families if name not in FAMILIES]:
            raise ValueError(f"GeneratorConfig.mechanism_families has {unknown[0]!r}; there are {', '.join(FAMILIES)}")
        if len(set(self.mechanism_families)) < len(self.mechanism_families):
            raise ValueError("GeneratorConfig.mechanism_families names a family twice; use mechanism_weights")
        if self.mechanism_weights and len(self.mechanism_weights) != len(self.mechanism_families):
            raise ValueError(
                f"GeneratorConfig.mechanism_weights has {len(self.mechanism_weights)} numbers for "
                f"{len(self.mechanism_families)} families; give one for each, or an empty list for equal ones"
            )
        if not all(0.0 < weight < math.inf for weight in self.mechanism_weights):
            raise ValueError(
                "GeneratorConfig.mechanism_weights must be finite and above 0; leave out a family that is not wanted"
            )
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

    @property
    def weight_of_family(self) -> dict[str, float]:
        """Weight of each of `mechanism_families`, in their order."""
        return dict(zip(self.mechanism_families, self.mechanism_weights or (1.0,) * len(self.mechanism_families)))


GENERATORS = {
    "default": GeneratorConfig(),
    "kinetix": GeneratorConfig(  # the public package, 3.0.2
        num_proposals_s=1,
        published_details=PUBLISHED_DETAILS,
        fixed_joint_chance=0.5,
        min_revolute_joints=2,
        forced_motor_on_chance=0.8,
    ),
    "locomotion": GeneratorConfig(mechanism_share=1.0),
    "tasks": GeneratorConfig(mechanism_share=1.0, mechanism_families=TASK_FAMILIES),
    **{family: GeneratorConfig(mechanism_share=1.0, mechanism_families=(family,)) for family in FAMILIES},
}


def generator(name: str) -> GeneratorConfig:
    """The parameters of that name; raises ValueError where there are none."""
    if name not in GENERATORS:
        hint = did_you_mean(name, GENERATORS, f"generators are {', '.join(GENERATORS)}")
        raise ValueError(f"unknown generator {name!r}; {hint}")
    return GENERATORS[name]
