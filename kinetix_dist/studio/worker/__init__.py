"""The engine worker: a process with jax that draws, checks, changes and plays levels for the server."""
