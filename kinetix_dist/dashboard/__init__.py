"""What dashboards show of runs: read from run directories alone, without jax, and never written to them."""
