"""Probes that `doctor` runs in a process of their own: `python -m kinetix_dist.cli.doctor_probes NAME`.

A driver that hangs or a library that crashes then costs one check, not the report. A probe prints one
JSON object as its last line; an exception ends the process with its message on stderr.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from typing import Any

from kinetix_dist.child_python import command_of
from kinetix_dist.errors import one_line
from kinetix_dist.installation import ENGINE
from kinetix_dist.json_text import json_text

MODULE = "kinetix_dist.cli.doctor_probes"
TIMEOUT_S = 120.0  # a first start of CUDA on a large host takes tens of seconds


class ProbeError(Exception):
    """A probe that failed, with the last line of what it said."""


def run_probe(name: str) -> dict[str, Any]:
    """Runs a probe in a new process and returns what it found; raises `ProbeError`."""
    command = command_of(MODULE, name)
    if name == "warp":
        # By its path: importing the package jax2d would import jax, and a broken jax is another check's finding.
        command = command_of(str(ENGINE / "warp" / "self_check.py"))
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise ProbeError(f"no answer within {TIMEOUT_S:.0f} s") from error
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise ProbeError(one_line(lines[-1]) if lines else f"ended with status {done.returncode} and no message")
    return json.loads(done.stdout.splitlines()[-1])


def probe_jax() -> dict[str, Any]:
    """Devices of the default platform, and a small program compiled and run on the first of them."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # look at the GPU without taking its memory
    import jax
    import jax.numpy as jnp

    from kinetix_dist.errors import UserError
    from kinetix_dist.jax_checks import arithmetic_complaint, check_settings
    from kinetix_dist.models.kernels.support import why_no_device

    try:
        check_settings()
    except UserError as error:
        sys.exit(str(error))
    devices = jax.devices()
    started = time.perf_counter()
    total = float(jax.jit(lambda x: (x @ x).sum())(jnp.ones((64, 64), jnp.float32)))
    if total != 64.0**3:
        raise RuntimeError(f"a 64x64 product of ones summed to {total}, not to {64.0**3}")
    return {
        "version": jax.__version__,
        "platform": devices[0].platform,
        "devices": [device.device_kind for device in devices],
        "no_kernels": why_no_device(),
        "wrong_arithmetic": arithmetic_complaint(),
        "compile_seconds": round(time.perf_counter() - started, 2),
    }


def probe_ray() -> dict[str, Any]:
    """Checks that ray can be imported; no cluster is started."""
    import ray

    return {"version": ray.__version__}


def probe_driver() -> dict[str, Any]:
    """The CUDA version that the NVIDIA driver supports and the number of GPUs, by the driver itself."""
    import ctypes

    cuda = ctypes.CDLL("libcuda.so.1")
    version, count = ctypes.c_int(), ctypes.c_int()
    status = (
        cuda.cuInit(0) or cuda.cuDriverGetVersion(ctypes.byref(version)) or cuda.cuDeviceGetCount(ctypes.byref(count))
    )
    if status != 0:
        raise RuntimeError(f"the NVIDIA driver answers with CUDA error {status}")
    return {"cuda_version": f"{version.value // 1000}.{version.value % 1000 // 10}", "gpus": count.value}


PROBES = {"jax": probe_jax, "ray": probe_ray, "driver": probe_driver}

if __name__ == "__main__":
    print(json_text(PROBES[sys.argv[1]]()))
