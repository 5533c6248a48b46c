"""Web server of the pages: one process without jax that answers those who have its token."""
