"""Searches for actions that solve a level: many worlds at once, from its start or from stored states."""
