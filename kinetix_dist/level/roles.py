"""Roles a shape can play in the task: make green touch blue, and keep it off red."""

import enum


class Role(enum.IntEnum):
    """Role of a shape; the numbers are those of the public Kinetix level files."""

    NONE = 0
    GREEN = 1
    BLUE = 2  # the goal
    RED = 3  # touching it with green ends the episode with -1


ROLE_NAMES = tuple(role.name.lower() for role in Role)  # as level files spell them
