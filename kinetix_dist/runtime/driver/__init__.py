"""Driver of a run: begin with `controller.py`. Other packages call `runtime.train`.

Puts together what `cores/` computes and what `processes/` starts, and owns the run directory.

"""
