"""The Python interface: what `import kinetix_dist as kd` offers to scripts and notebooks."""
