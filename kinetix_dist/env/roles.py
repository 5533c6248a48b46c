"""Roles a shape can play in the task, defined with the levels that assign them."""

from kinetix_dist.level.roles import Role

__all__ = ["Role"]
