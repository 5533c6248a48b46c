"""Programs of Pallas kernels that are the same in every process, whatever calls them and in which order.

Two things that Pallas puts into a kernel's program are of no use to the device: the frames of Python that each
operation was traced from, and a number of the kernel among those of the process, for names of dumps. They become part
of every program that launches it, in the compile cache too: a run that is resumed needs the rollout's program first
where one that begins has evaluated before, and would compile all of them again.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any

from jax.experimental.mosaic.gpu import dialect
from jax.extend import source_info_util

_DUMP_OPTIONS = "get_or_set_dump_options"  # function of the dialect in JAX 0.11
DUMP_NAME = "mosaic_gpu.dump_basename"  # attribute of a kernel's module
DUMPS = "MOSAIC_GPU_DUMP"  # prefix of environment variables that request dumps


def without_caller_frames(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """`kernel`, whose operations have their frames in this file alone."""

    def launch(*arrays: Any) -> Any:
        with source_info_util.user_context(_HERE, name_stack=source_info_util.new_name_stack()):
            return kernel(*arrays)

    return launch


def _here() -> Any:
    """Traceback without the frames of the importer: from a thread, whose first frame is here."""
    found = []

    def frames_of_callers_are_left_out() -> None:  # what errors and profiles show
        found.append(source_info_util.current().traceback)

    thread = threading.Thread(target=frames_of_callers_are_left_out)
    thread.start()
    thread.join()
    return found[0]


def _name_dumps_alike() -> None:
    """Kernels have no number, unless dumps are requested, which would overwrite each other."""
    ask = getattr(dialect, _DUMP_OPTIONS, None)  # there is no public way (jax 0.11)
    if ask is None:  # jax 0.10: kernels have no number in a program
        return

    def named(module: Any) -> Any:
        attributes = module.operation.attributes
        if DUMP_NAME not in attributes and not any(name.startswith(DUMPS) for name in os.environ):
            attributes[DUMP_NAME] = attributes["sym_name"]
        return ask(module)

    setattr(dialect, _DUMP_OPTIONS, named)


_HERE = _here()
_name_dumps_alike()
