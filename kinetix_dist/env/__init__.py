"""Environment, observations, reward and actions. Imports `kinetix_dist.level` and `jax2d`, never models or learner."""
