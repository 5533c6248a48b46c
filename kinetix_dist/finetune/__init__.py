"""Specialists: one policy a level, from scratch and from a policy that exists, and how many samples each needs."""
