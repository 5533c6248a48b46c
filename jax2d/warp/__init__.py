"""The Warp backend: one fused kernel in which one thread steps one world."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # by default Warp prints a banner, and a line for every kernel it loads
