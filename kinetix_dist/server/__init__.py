"""The web server of dashboards and editor: one process without jax, on this machine, for whoever has its token."""
