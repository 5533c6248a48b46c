"""Whether Warp works on this machine at all: one small kernel compiled for the CPU and run.

Run as a program (`python jax2d/warp/self_check.py`) it prints its findings as JSON. `kinetix-dist doctor` does
that in a process of its own, because a broken compiler may take the process with it. Imports nothing but Warp.
"""

import json
import time

import warp as wp


@wp.kernel(enable_backward=False)
def _double_of_index(doubled: wp.array(dtype=float)):  # type: ignore[valid-type]
    i = wp.tid()
    doubled[i] = 2.0 * float(i)


def self_check() -> dict:
    """Returns Warp's version, the CUDA devices it sees and the seconds the CPU kernel took to compile and run.

    Raises RuntimeError where the kernel runs and computes something else than it should.
    """
    wp.config.quiet = True
    wp.init()
    started = time.perf_counter()
    doubled = wp.zeros(4, dtype=float, device="cpu")
    wp.launch(_double_of_index, dim=4, inputs=[doubled], device="cpu")
    values = doubled.numpy().tolist()
    if values != [0.0, 2.0, 4.0, 6.0]:
        raise RuntimeError(f"a kernel that doubles its index wrote {values}, not [0, 2, 4, 6]")
    return {
        "version": wp.config.version,
        "cuda_devices": [device.name for device in wp.get_cuda_devices()],
        "compile_seconds": round(time.perf_counter() - started, 2),
    }


if __name__ == "__main__":
    print(json.dumps(self_check()))  # noqa: T201
