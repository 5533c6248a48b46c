"""Numbers that the solver's code fixes: tolerances, feature codes and keys, each with its unit and its reason.

Both backends take them from here: the reference reads `CONSTANTS`, the kernel gets them as C++ macros of the same names
in capitals (`cpp_macros`). Numbers that a user may choose are `Settings` instead.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any


def _constant(value: float, unit: str, reason: str, beyond: str = "") -> Any:
    """`beyond`: what breaks with another value."""
    return dataclasses.field(default=value, metadata={"unit": unit, "reason": reason, "beyond": beyond})


@dataclasses.dataclass(frozen=True)
class Constants:
    """See the fields; `unit`, `reason` and `beyond` stand in their metadata."""

    # Angles
    half_turn: float = _constant(math.pi, "rad", "beyond it an angle is wrapped", "other: angles jump")
    turn_high: float = _constant(6.28125, "rad", "a turn to nine bits, of which float32 holds multiples exactly")
    turn_low: float = _constant(2 * math.pi - 6.28125, "rad", "what it lacks of a turn", "0: 3 mrad are lost a turn")
    wide_limits: float = _constant(
        1.5 * math.pi,
        "rad",
        "limits that span more say how often a body has turned: it is not wrapped",
        "2 pi: what leans into one limit comes out at the other",
    )
    # Geometry
    far_distance: float = _constant(
        1e30, "m", "a distance of what does not exist", "float32 overflows when squared: compared only"
    )
    no_maximum: float = _constant(1e18, "m", "the longest length of a spring that may be of any", "smaller: it acts")
    coincident_distance: float = _constant(
        1e-9,
        "m",
        "centres closer than this have no direction of their own",
        "larger: touching points lose their normal",
    )
    on_face_distance: float = _constant(
        1e-7, "m", "a circle's centre this near a face counts as inside", "0: the normal of a corner has no length"
    )
    min_span: float = _constant(
        1e-9, "m", "an incident edge shorter along the face is not clipped", "0: division by zero"
    )
    flip_advantage: float = _constant(
        0.0005, "m", "the other face must be better by it to become the reference", "0: normals flicker near a tie"
    )
    clearly_larger: float = _constant(
        1.1, "ratio of extents", "from here on the larger shape's face is the reference", "1: equal boxes flicker"
    )
    aside_share: float = _constant(
        0.02,
        "share of their distance",
        "discs that bounce and pass by so much in a step do so in the sub-step in which they meet",
        "larger: they get spin from where the step ends",
    )
    grazing_distance: float = _constant(
        0.005,
        "m",
        "shapes that are level to within it, or miss each other by it, slide past rather than meet",
        "0: seams of a tiled floor stop what slides over them; larger: steps of that height become seamless",
    )
    grazing_share: float = _constant(
        0.05,
        "of a radius",
        "for small discs instead of grazing_distance",
        "1: a small disc misses what it hits squarely",
    )
    thin_share: float = _constant(
        0.5,
        "of an edge",
        "a face covered by more is met in full, however thin",
        "1: thin shapes pass each other's ends",
    )
    touching_distance: float = _constant(
        1e-5,
        "m",
        "surfaces nearer than this touch: a gap that a contact has closed is 0 to rounding",
        "0: rounding decides whether what touches is soft, and a world that is turned moves otherwise",
    )
    resting_speed: float = _constant(
        0.1,
        "m/s",
        "slower than this, what overlaps or is about to meet rests where it is",
        "0: resting shapes slide off",
    )
    min_impact_speed: float = _constant(
        0.6,
        "m/s",
        "what meets faster than this gets normal impulse and friction together",
        "0.3: a house of cards falls; larger: boxes that land on a corner rebound",
    )
    point_rounds: int = _constant(
        8, "a pass", "both points of an impact are solved in turn", "0: a box that lands flat tips"
    )
    shared_speed: float = _constant(
        0.12,
        "m/s",
        "a contact that an impact changes by more hands it on to what else its bodies touch",
        "0.03: time only",
    )
    settled_speed: float = _constant(
        0.03, "m/s", "an impact is shared out when no contact changes by more", "0: time only"
    )
    least_curve: float = _constant(
        1e-5,
        "of the energy of what contacts have changed",
        "what joints leave of it is known to so much (line search)",
        "0: rounding decides how far a pass goes where joints take all of it",
    )
    min_separating_speed: float = _constant(
        0.2,
        "m/s",
        "what comes apart faster is not warm-started",
        "0.1: a house of cards falls; 0.4: what an impact left behind throws piles apart",
    )
    energy_passes: int = _constant(
        4,
        "a sub-step",
        "relax passes are repeated so often where an island has gained energy, which is bounded then",
        "0: shares in what is jammed are coarse; 12: the same, for more time",
    )
    kept_gain: float = _constant(
        0.1,
        "J/kg",
        "impulses that give as much more are kept for a warm start",
        "0: a press lets go; 1: jams are thrown",
    )
    slack_rate: float = _constant(
        5.0, "1/s", "a gain in energy that is left", "0: several times the passes, for nothing that is seen"
    )
    slack_power: float = _constant(
        0.3, "W/kg", "as much again, since what rests has no energy", "0: piles at rest are solved again"
    )
    # Contacts found ahead of motion
    safe_core_share: float = _constant(
        0.5, "of the smaller core", "a pair that moves farther in a step could pass through", "1: thin pairs tunnel"
    )
    max_stops: int = _constant(
        8,
        "a sub-step",
        "islands are stopped so often to find their contacts again",
        "fewer: fast crowds tunnel; more: time only",
    )
    limited_passes: int = _constant(
        8,
        "a sub-step",
        "where speed limits act, islands are solved again so often for what they take from contacts",
        "0: what spins at its limit passes the end of a wall",
    )
    sweep_rounding: float = _constant(
        2.0**-20,
        "of a coordinate",
        "sixteen times the rounding of one float32 operation",
        "0: sweep and pair test differ",
    )
    # Servos
    servo_braking_share: float = _constant(
        0.5,
        "of what the motor gives the joint with all that is held",
        "slows down a servo before its position; the rest is for forces",
        "1: it overshoots with any force",
    )
    # Joints
    open_gap: float = _constant(
        0.01,
        "m",
        "a joint with a wider gap counts as open, and a rope or rod whose length is wrong by more",
        "0.001: links that yield are counted",
    )
    open_turn: float = _constant(0.05, "rad", "as much at an arm of 20 cm, of welds and sliders")
    joint_compliance: float = _constant(
        1e-3,
        "of the inverse masses of two bodies",
        "a joint yields by it, so that no impulse is without bound",
        "0: a taut bridge tears; 4e-3: a toggle near its dead centre is 4 % off",
    )
    joint_rounding: float = _constant(
        4e-6,
        "of the inverse effective mass of a joint",
        "elimination in float32 rounds off by less",
        "0: tangles of light parts on long arms are NaN",
    )
    axial_changes: int = _constant(
        8,
        "a round",
        "so often what motors and limits hold is chosen again",
        "4: of an arm of six motors that lashes about 3 % have not their speed",
    )
    # Springs
    spring_passes: int = _constant(
        2, "a pass with bias", "stiff springs in a row agree", "1: ten in a row with a heavy end gain energy"
    )
    rod_strength: float = _constant(
        1.0,
        "1",
        "the largest impulse of a rope or rod, of its length times the mass across it over the sub-step: with more it "
        "would swing faster than a sub-step can follow",
        "2: what is too heavy falls on, as light discs lash about; 0.5: rods give way to half the load",
    )
    # Bounces
    max_impacts: int = _constant(
        32,
        "an island and step",
        "an impact is passed on from disc to disc so many times",
        "fewer: what is left of it stops in a long row of discs",
    )
    simultaneous_share: float = _constant(
        0.001,
        "of the fastest impact's speed",
        "impacts whose speeds differ by less are solved as one, to so much",
        "0: which of two that are alike comes first is decided by rounding",
    )
    bounce_tolerance: float = _constant(0.002, "of the speed to leave with", "closer than this a bounce has converged")
    min_gained_share: float = _constant(
        0.001,
        "of a push",
        "a push that leaves less than this changes nothing any more",
        "0: jammed bounces use all rounds",
    )
    min_secant_share: float = _constant(
        0.125, "of a push", "the effective mass grows by eight a round at most", "0: one bad round throws a body"
    )
    max_secant_share: float = _constant(
        2.0, "of a push", "more than this is no answer to the push", "larger: oscillation"
    )
    energy_rounding: float = _constant(
        1e-5, "of what bounces give", "sums in float32 may be wrong by it", "0: exact bounces shrink"
    )
    # Features tell a contact's points apart between steps.
    feature_edge: int = _constant(8, "a step of the reference edge's number", "8 vertices at most")
    feature_flipped: int = _constant(64, "flag", "the reference face is that of b")
    feature_corner_outside: int = _constant(128, "flag", "corner against corner, apart")
    feature_corner_inside: int = _constant(256, "flag", "corner against corner, overlapping")
    feature_seam: int = _constant(384, "flag", "a seam between faces")
    feature_incident: int = _constant(512, "a step of the incident edge's number", "4,096 features fill the key's bits")
    # Keys: shape a, shape b, feature, in one positive int32
    feature_bits: int = _constant(12, "bits", "of the feature, the lowest ones")
    shape_bits: int = _constant(10, "bits", "of a shape's number", "512 shapes: a's number keeps the sign bit free")


CONSTANTS = Constants()


def cpp_macros() -> str:
    """One `#define` a constant, float32 for floats."""
    lines = []
    for field in dataclasses.fields(CONSTANTS):
        value = getattr(CONSTANTS, field.name)
        text = f"real({value!r})" if isinstance(value, float) else str(value)
        lines.append(f"#define {field.name.upper()} {text}")
    return "\n".join(lines)
