"""Counters of the physics over all sessions of a run, and one warning for each that should be zero and is not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

PREFIX = "physics/"
COUNTED_AS_NUMBER = "physics/unstable_worlds"  # the same as physics/unstable

# What should be zero: (what happened, what to do). Speed limits may act.
WARNINGS = {
    "unstable": (
        "worlds were not finite and were reset",
        "raise env.physics.substeps or take --env.preset fine; metric physics/unstable counts them",
    ),
    "contact_overflow": (
        "contacts found no slot in the engine and did nothing",
        "levels are more crowded than size env.size has room for; take a larger one",
    ),
    "missing_effects": (
        "environment steps lacked an effect that their level calls for",
        "report it: the engine was made for fewer effects than the run needs",
    ),
    "invalid_actions": (
        "numbers of actions were out of range and acted as off",
        "the policy and env.action_space do not belong together",
    ),
    "invalid_controls": (
        "controls were out of range or nan",
        "look at the levels with `kinetix-dist levels validate`",
    ),
    "invalid_scene": (
        "joints, thrusters or polygons of levels made no sense, counted in every step",
        "look at the levels with `kinetix-dist levels validate`",
    ),
}


class PhysicsWatch:
    """Adds up the metrics of updates."""

    def __init__(self) -> None:
        self._physics_steps = 0
        self._counts: dict[str, int] = {}
        self._warned: set[str] = set()

    @property
    def totals(self) -> dict[str, int]:
        """For the report: physics steps of all worlds, and how often each thing happened in them."""
        return {"physics_steps": self._physics_steps, **self._counts}

    def add_earlier(self, totals: Mapping[str, int]) -> None:
        """`totals` of earlier sessions."""
        for name, count in totals.items():
            if name == "physics_steps":
                self._physics_steps += count
            else:
                self._counts[name] = self._counts.get(name, 0) + count

    def add(self, metrics: Mapping[str, float], physics_steps: int) -> Iterator[tuple[str, int, str]]:
        """Takes the metrics of an update of so many physics steps; (kind, count, warning) the first time of a kind."""
        self._physics_steps += physics_steps
        for name, rate in metrics.items():
            if not name.startswith(PREFIX) or name == COUNTED_AS_NUMBER:
                continue
            kind = name.removeprefix(PREFIX)
            count = round(rate * physics_steps / 1e6)
            self._counts[kind] = self._counts.get(kind, 0) + count
            if count and kind in WARNINGS and kind not in self._warned:
                self._warned.add(kind)
                what, remedy = WARNINGS[kind]
                yield kind, count, f"physics: {count:,} {what} in {physics_steps:,} physics steps; {remedy}"
