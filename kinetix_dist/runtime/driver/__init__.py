"""What drives a run: begin with `controller.py`. `training_run.train` is the way in, for the commands.

Called by `kinetix_dist/cli/` and by tests; nothing else. It puts together what `cores/` computes and what `processes/`
starts, and owns the run directory.
"""
