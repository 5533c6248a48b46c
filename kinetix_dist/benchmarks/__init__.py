"""Benchmarks that a user runs on a machine of their own: the engine, training, the learner, scaling, the curator.

A benchmark is a module with `Options`, a frozen dataclass whose fields are its flags, and `measure(options, results)`.
Only the command line (`kinetix_dist/cli/bench.py`) and the scripts of bench/ call them. `training_run.py` is the one
file that imports the runtime.
"""
