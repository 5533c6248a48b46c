"""Warp's messages at start reach the user, but for one line."""

from __future__ import annotations

import os

from jax2d.warp.startup import without_line_about_no_driver


def test_only_the_line_about_a_missing_driver_is_left_out(capfd):
    with without_line_about_no_driver():
        os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution\n")
        os.write(2, b"Warp CUDA error: something else\n")
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "Warp CUDA error: something else\nafterwards\n"
