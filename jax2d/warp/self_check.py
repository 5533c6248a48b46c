"""Check of Warp on this machine: one small kernel compiled for each kind of device and run.

Run as a program (`python jax2d/warp/self_check.py`) it prints its findings as JSON. `kinetix-dist doctor` does
that in a process of its own, because a broken compiler may take the process with it. Imports nothing but Warp.
"""

import json
import time

import warp as wp


@wp.kernel(enable_backward=False)
def _double_of_index(doubled: wp.array(dtype=float)):  # pyrefly: ignore[invalid-annotation]  # Warp reads it
    i = wp.tid()
    doubled[i] = 2.0 * float(i)  # pyrefly: ignore[bad-argument-type]  # an int in a launch of one dimension


def self_check() -> dict:
    """Returns Warp's version, the CUDA devices it sees, and for the CPU and the first of these what became of a kernel:

    `{"cpu": {"seconds": to compile and run} or {"error": one line}, "cuda:0": ...}` under "kernel".
    """
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    cuda_devices = wp.get_cuda_devices()
    kernel = {name: _try(name) for name in ["cpu", *[device.alias for device in cuda_devices[:1]]]}
    return {"version": wp.config.version, "cuda_devices": [device.name for device in cuda_devices], "kernel": kernel}


def _try(device: str) -> dict:
    started = time.perf_counter()
    try:
        doubled = wp.zeros(4, dtype=float, device=device)
        wp.launch(_double_of_index, dim=4, inputs=[doubled], device=device)
        values = doubled.numpy().tolist()
    except Exception as error:  # whatever a driver or a compiler may raise is the finding
        return {"error": " ".join(f"{type(error).__name__}: {error}".split())}
    if values != [0.0, 2.0, 4.0, 6.0]:
        return {"error": f"a kernel that doubles its index wrote {values}, not [0, 2, 4, 6]"}
    return {"seconds": round(time.perf_counter() - started, 2)}


if __name__ == "__main__":
    print(json.dumps(self_check()))  # noqa: T201
