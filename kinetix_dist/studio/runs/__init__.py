"""Readers of run directories: metrics, events, evaluations, curricula, processes. No jax; nothing is written."""
