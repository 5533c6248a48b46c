"""Solver settings and the named presets of them. A preset is a point on the accuracy-time curve.

`paper` is the sequential-impulse solver of the Kinetix paper's appendix, for comparison; `standard`
is soft-step sub-stepping as in Box2D v3 and is the default. Formulas stand in docs/engine_solver.md.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
from typing import Literal

from jax2d.whole_numbers import whole_number

Solver = Literal["soft_step", "sequential_impulses"]

# What soft_step takes a body to turn by at most, at max_angular_speed.
MAX_TURN_PER_SUBSTEP = 0.5  # rad; contacts are planes, and rotations a series of third order: 0.1 % off there, 7 % at 1
MAX_TURN_PER_STEP = 2.0  # rad; contact points turn by series that are 1 % off there, and 24 % at half a turn


def fastest_spin(dt: float, substeps: int) -> float:
    """rad/s, the most that `max_angular_speed` may be with soft_step."""
    return min(MAX_TURN_PER_SUBSTEP * substeps, MAX_TURN_PER_STEP) / dt


def _is_finite(value: numbers.Real) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an int beyond all floats
        return False


POSITIVE = {  # fields that cannot be 0, as others can
    "max_speed": "nothing would move; the largest that a body may have, in m/s, is above 0",
    "max_angular_speed": "nothing would turn; the largest that a body may have, in rad/s, is above 0",
    "contact_hertz": "contacts would hold nothing apart; give their stiffness in Hz",
    "spring_hertz": "springs would hold nothing; give the stiffness of the stiffest in Hz",
}


COUNTS = {  # fields that are whole numbers -> the least and the most that they may be
    "substeps": (1, 1000),
    "impact_passes": (0, 1000),
    "bounce_rounds": (1, 1000),
    "solver_batch_size": (1, 1000),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of the solver. Numbers are run-time parameters of a compiled engine; `solver`, `line_search`,
    `friction_mixing`, `solver_batch_size` and whether there are `impact_passes` are compiled in."""

    solver: Solver = "soft_step"
    dt: float = 1 / 60  # s, one physics step
    substeps: int = 4  # soft_step: sub-steps of dt / substeps; sequential_impulses: solver iterations

    # What the units of a level mean
    base_friction: float = 0.4 * math.sqrt(
        2.0
    )  # times the mixed coefficient; equal bodies have the friction of `paper`
    friction_mixing: Literal["geometric_mean", "root_sum_square"] = "geometric_mean"
    base_motor_speed: float = 6.0  # rad/s at motor_speed 1
    base_motor_power: float = 900.0  # rad/s^2 that a motor of power 1 gives to its two bodies alone
    base_slider_speed: float = 2.0  # m/s at motor_speed 1 of a prismatic joint
    base_slider_power: float = 100.0  # m/s^2 that its motor of power 1 gives to its two bodies alone
    base_thruster_power: float = 10.0  # N at thruster_power 1

    warm_start: bool = True  # steps begin with the impulses of the step before; off is for studying what that is worth

    # Limits: they act on nothing ordinary; whenever one acts, Touching.limited counts it
    max_speed: float = 100.0  # m/s
    max_angular_speed: float = 50.0  # rad/s, 0.83 rad a step at 60 Hz

    # soft_step
    contact_hertz: float = 45.0  # stiffness, at most contact_hertz_share / h; at 30 a column of 15 boxes buckles
    contact_hertz_share: float = 0.1875
    contact_damping_ratio: float = 10.0
    spring_hertz: float = 88.0  # of the stiffest springs, at most spring_hertz_share / h
    spring_hertz_share: float = 0.367
    spring_damping_ratio: float = 10.0
    joint_correction: float = 0.2  # share of the error of a joint that is undone in a sub-step
    push_out_speed: float = 3.0  # m/s, fastest at which overlap is undone
    joint_pull_speed: float = 3.0  # m/s, fastest at which the gap of a joint is closed
    joint_turn_speed: float = 4.0  # rad/s, fastest at which a joint turns back from beyond a limit, or a weld
    speculative_distance: float = 0.02  # m, contacts are prepared from here on (4 x Box2D's linear slop)
    restitution_threshold: float = 1.0  # m/s, slower impacts do not bounce, so that stacks come to rest
    bounce_rounds: int = 16  # at most, in which joints and other contacts share in a bounce
    impact_passes: int = 0  # at most, in which they share in an impact with friction; 0: only what hits is stopped
    line_search: bool = False  # contacts of jointed bodies push by what bears on them, not by their own masses

    # sequential_impulses (published constants)
    slop: float = 0.01  # m, penetration left alone
    collision_correction: float = 0.2  # share of the penetration beyond slop undone a step
    joint_velocity_correction: float = 2.0  # 1/s
    joint_position_correction: float = 0.7
    joint_stiffness: float = 0.6
    fixed_angle_rate: float = 2.0  # 1/s
    limit_angle_rate: float = 5.0  # 1/s
    motor_decay: float = 0.1  # s/rad, rho in p tanh((w - sA) rho)
    motor_fade_angle: float = 0.1  # rad before a limit within which a motor weakens
    solver_batch_size: int = 1  # contacts solved at a time from the same velocities; the published package's is 16

    def __post_init__(self) -> None:
        self._check_types()
        if self.solver not in ("soft_step", "sequential_impulses"):
            raise ValueError(f"Settings.solver is {self.solver!r}; use 'soft_step' or 'sequential_impulses'")
        if self.friction_mixing not in ("geometric_mean", "root_sum_square"):
            raise ValueError(
                f"Settings.friction_mixing is {self.friction_mixing!r}; use 'geometric_mean' or 'root_sum_square'"
            )
        if self.dt == 0:
            raise ValueError(f"Settings.dt is {self.dt}; a step must take a positive time in seconds")
        for name, what in POSITIVE.items():
            if getattr(self, name) == 0:
                raise ValueError(f"Settings.{name} is {getattr(self, name)}; {what}")
        for name, (least, most) in COUNTS.items():
            if not least <= (count := getattr(self, name)) <= most:
                raise ValueError(f"Settings.{name} is {count}; it must be from {least} to {most}")
        if self.solver_batch_size > 1 and self.solver == "soft_step":
            raise ValueError(
                f"Settings.solver_batch_size is {self.solver_batch_size}, but soft_step solves contacts one after "
                "another; use 1, or solver='sequential_impulses'"
            )
        self._check_turns()

    def _check_turns(self) -> None:
        """A body that turns too far at a time passes through what is in its way."""
        fastest = fastest_spin(self.dt, self.substeps)
        if self.solver == "soft_step" and self.max_angular_speed > fastest * (1 + 1e-9):
            raise ValueError(
                f"Settings.max_angular_speed is {self.max_angular_speed:g}: a body could turn by "
                f"{self.max_angular_speed * self.substep_seconds:.2g} rad a sub-step and "
                f"{self.max_angular_speed * self.dt:.2g} rad a step, and contacts hold for "
                f"{MAX_TURN_PER_SUBSTEP:g} and {MAX_TURN_PER_STEP:g}; lower it to {fastest:.4g}, "
                "lower dt or raise substeps"
            )

    def _check_types(self) -> None:
        """Every field by its declared type; numbers are finite and not negative."""
        for field in dataclasses.fields(self):
            name, value = f"Settings.{field.name}", getattr(self, field.name)
            if field.type == "int":
                whole_number(name, value)
            elif field.type == "float":
                if not isinstance(value, numbers.Real) or isinstance(value, bool):
                    raise ValueError(f"{name} is {value!r}; it must be a number")
                if not _is_finite(value) or value < 0:
                    raise ValueError(f"{name} is {value}; it must be finite and not negative")
            elif field.type == "bool" and not isinstance(value, bool):
                raise ValueError(f"{name} is {value!r}; it must be True or False")

    @property
    def substep_seconds(self) -> float:
        """h: what constraints are solved over."""
        return self.dt / self.substeps if self.solver == "soft_step" else self.dt

    def replace(self, **changes: object) -> Settings:
        names = [field.name for field in dataclasses.fields(self)]
        if unknown := changes.keys() - set(names):
            near = difflib.get_close_matches(min(unknown), names, 1)
            raise ValueError(f"settings have no {min(unknown)}" + (f"; there is {near[0]}" if near else ""))
        return dataclasses.replace(self, **changes)


PRESETS: dict[str, Settings] = {
    # Half the sub-steps, and contacts and springs half as stiff (both are capped at a share of 1 / h): columns of ten,
    # loads of 400 times the mass and heavy pendulums are beyond it.
    "draft": Settings(substeps=2, spring_hertz_share=0.25, spring_damping_ratio=4.0),
    "standard": Settings(),
    # Four times the sub-steps, and stiffness that rises with them: otherwise its sag would stay that of `standard`.
    # Overlap is undone more slowly, since stiffer contacts pass that speed on from body to body.
    "fine": Settings(
        substeps=16,
        contact_hertz=1000.0,
        spring_hertz=1000.0,
        push_out_speed=2.0,
        impact_passes=16,
        line_search=True,
    ),
    "paper": Settings(solver="sequential_impulses", substeps=10, base_friction=0.4, friction_mixing="root_sum_square"),
    # For measuring, in float64 (`Engine(..., backend="xla", dtype=jnp.float64)`): in float32 so short a step moves
    # nothing slow. Error of first order in dt, so that half and a quarter of it can be extrapolated from.
    "reference": Settings(dt=1 / 61440, substeps=1, contact_hertz=1e5, spring_hertz=1e5),
}


def preset(name: str) -> Settings:
    """The named settings; raises ValueError with the known names for any other."""
    if not isinstance(name, str) or name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}; known presets: {', '.join(sorted(PRESETS))}")
    return PRESETS[name]


def checked_settings(given: Settings | None) -> Settings:
    """Returns the settings of a caller; None is preset standard. Raises TypeError for the name of a preset."""
    if given is None:
        return preset("standard")
    if not isinstance(given, Settings):
        name = given if isinstance(given, str) and given in PRESETS else "standard"
        raise TypeError(f"settings is {given!r}, not Settings; give settings=preset({name!r}), for example")
    return given
