"""kinetix-dist: pretrains agents on 2D rigid-body worlds that the engine `jax2d` simulates."""

from kinetix_dist import installation

installation.guard()
