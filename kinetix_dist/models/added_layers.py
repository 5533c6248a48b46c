"""Layers added to a transformer that has learned: the deeper network begins as nearly the function that it was.

As Net2DeeperNet (Chen, Goodfellow and Shlens 2016) and ReZero (Bachlechner et al. 2021) have it: an added layer lets
little or nothing into the stream of tokens, and learns to. It comes behind the others, before pooling.

    messages            kernels are zero: exactly nothing
    plain residuals     kernels of their outputs are zero: exactly nothing
    gates               what opens them (z in gate.py) is their bias alone, `GATE_BIAS`: they let in sigmoid(-3), about
                        5 %, of everything. With less they would hardly learn: gradients are as small. The stream is not
                        normalised, so that kernels as they are initialised would open some of them wide
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

GATE_BIAS = 3.0
_OF_LAYER = re.compile(r"(?:^|/)(attention|feed_forward|joint_messages|thruster_messages)_(\d+)_(\w+)$")
# Columns of a gate's kernels, counted in widths of a token: those of z.
_OPENS = {"gate_update_kernel": 1, "gate_stream_kernel": 1}


def num_layers_of(params: Mapping[str, np.ndarray]) -> int:
    """Number of layers in a transformer's parameters by path; 0 for other networks."""
    return 1 + max((int(match[2]) for name in params if (match := _OF_LAYER.search(name))), default=-1)


def with_added_layers(params: Mapping[str, np.ndarray], fresh: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """`params`, and those of the layers that `fresh`, parameters of a deeper network as they are initialised, has more
    of. By path; nothing else is taken of `fresh`."""
    count, added = num_layers_of(params), {}
    for name, array in fresh.items():
        match = _OF_LAYER.search(name)
        if match is None or int(match[2]) < count:
            continue
        of, what = match[1], match[3]
        is_gated = f"{name[: match.start(3)]}gate_bias" in fresh
        if what == "gate_bias":
            array = np.full_like(array, GATE_BIAS)
        elif what in _OPENS:
            array = _without(array, _OPENS[what])
        elif what == ("kernel" if of.endswith("messages") else "out_kernel") and not is_gated:
            array = np.zeros_like(array)
        added[name] = array
    return dict(params) | added


def _without(kernel: np.ndarray, part: int) -> np.ndarray:
    """`kernel` [F, parts F] with zeros in one of its parts."""
    width = kernel.shape[0]
    kernel = np.array(kernel)
    kernel[:, part * width : (part + 1) * width] = 0.0
    return kernel
