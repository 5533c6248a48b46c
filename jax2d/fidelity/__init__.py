"""Accuracy of the engine: scenes with a formula, scenes on which solvers fail, and what accuracy costs in time.

from jax2d import record

trajectory, state = record(engine, scene, state, num_samples=600)
"""

from jax2d.fidelity.trajectory import Trajectory, record, record_worlds

__all__ = ["Trajectory", "record", "record_worlds"]
