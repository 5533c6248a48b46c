"""Warp's messages at start reach the user, but for one line."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

from jax2d.warp.startup import without_line_about_no_driver


def test_only_the_line_about_a_missing_driver_is_left_out(capfd):
    with without_line_about_no_driver():
        os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution\n")
        os.write(2, b"Warp CUDA error: something else\n")
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "Warp CUDA error: something else\nafterwards\n"


def test_a_child_that_inherits_the_descriptor_is_not_waited_for(capfd):
    with without_line_about_no_driver():
        child = subprocess.Popen(["sleep", "60"])
    try:
        assert child.poll() is None
    finally:
        child.kill()
        child.wait()


def test_threads_that_start_warp_at_once_all_return():
    """The worker of the pages starts it from two pools of threads: once both redirected descriptor 2 and one waited for
    the other's pipe for good."""
    program = """
        import itertools, os, threading, time
        import warp
        from jax2d.warp import startup
        init, order, console = warp.init, itertools.count(1), os.fstat(2).st_ino
        warp.init = lambda: (time.sleep(0.5 * next(order)), init())
        threads = [threading.Thread(target=startup.start, daemon=True) for _ in range(2)]
        for thread in threads:
            thread.start()
            time.sleep(0.1)
        for thread in threads: thread.join(30)
        print(sum(thread.is_alive() for thread in threads), os.fstat(2).st_ino == console)
    """
    ran = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=90)
    assert ran.stdout.split()[-2:] == ["0", "True"], ran.stdout + ran.stderr
