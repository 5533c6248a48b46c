"""Checks of the installed JAX before anything is computed: its settings, and its arithmetic.

JAX takes its settings from the environment (`JAX_NUMPY_RANK_PROMOTION=raise`) or from `jax.config`. Some end a program
in the middle, others change what it computes. A row of `SETTINGS` makes such a value one line at the start.

jax-ml/jax#39103: jax 0.10.2 on CPUs computes `vmap(lambda r: sum((m @ r) ** 2))` wrongly in rows beyond 32,768 of
float32. Programs of training and of the engine map over worlds in the same way. The program itself is run, in 50 ms,
and compared with numpy: which versions and machines are concerned need not be known.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from kinetix_dist.errors import UserError


@dataclasses.dataclass(frozen=True)
class Setting:
    """A setting of JAX and its values that commands run with, the default first."""

    name: str
    values: tuple[object, ...]
    reason: str  # completes "with another value ..."


_TRANSFERS = (None, "allow", "log", "log_explicit")
_COPIES = "arrays of numpy could not be handed to programs"
SETTINGS = (
    Setting("jax_numpy_rank_promotion", ("allow", "warn"), "arrays of different ranks could not be combined"),
    Setting("jax_numpy_dtype_promotion", ("standard",), "arrays of different types could not be combined"),
    Setting("jax_transfer_guard", _TRANSFERS, _COPIES),
    Setting("jax_transfer_guard_host_to_device", _TRANSFERS, _COPIES),
    Setting("jax_transfer_guard_device_to_device", _TRANSFERS, _COPIES),
    Setting("jax_transfer_guard_device_to_host", _TRANSFERS, "results could not be read"),
)


def check_settings() -> None:
    """Raises UserError for the first setting of JAX in the list that commands do not run with."""
    import jax

    for setting in SETTINGS:
        if getattr(jax.config, setting.name) not in setting.values:
            raise UserError(_complaint(setting))


def _complaint(setting: Setting) -> str:
    import jax

    value = getattr(jax.config, setting.name)
    return (
        f"{setting.name.upper()} is {str(getattr(value, 'value', value))!r}, with which {setting.reason}; "
        f"unset it, or set it to {setting.values[0] or 'allow'!r}"
    )


NUM_ROWS = 32_769  # one more than are right in jax 0.10.2
RELATIVE_TOLERANCE = 1e-3  # sums of 3 squares in float32 are right to 1e-6; the wrong row is another number altogether


def check_arithmetic() -> None:
    """Raises UserError where this JAX computes wrongly on the CPU. Costs milliseconds, and nothing the second time."""
    if complaint := arithmetic_complaint():
        raise UserError(complaint)


@functools.cache
def arithmetic_complaint() -> str:
    """One line about what this JAX computes wrongly and what to do; empty where it is right, or has no CPU backend."""
    import jax

    platforms = jax.config.values["jax_platforms"]
    if platforms and "cpu" not in platforms.split(","):
        return ""
    random = np.random.default_rng(0)
    matrix = random.normal(size=(3, 3)).astype(np.float32)
    rows = random.normal(size=(NUM_ROWS, 3)).astype(np.float32)
    wrong = wrong_rows(_computed(matrix, rows), _expected(matrix, rows))
    if not wrong.size:
        return ""
    return (
        f"jax {jax.__version__} computes wrong numbers on this CPU: {wrong.size} of {NUM_ROWS} sums, the first of "
        f"row {wrong[0]} (jax-ml/jax#39103); install the versions of requirements.lock (`make install`), or jax 0.10.1 "
        "and jaxlib 0.10.1"
    )


def wrong_rows(computed: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Indices of rows that are not what they should be, also not finite ones. computed, expected: [n]."""
    return np.flatnonzero(~np.isclose(computed, expected, rtol=RELATIVE_TOLERANCE, atol=1e-6))


def _computed(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """[n] by XLA, as the report has it: the matrix is a constant of the program."""
    import jax
    import jax.numpy as jnp

    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        return np.asarray(jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(rows))


def _expected(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """[n] by numpy in float64."""
    return np.sum((rows.astype(np.float64) @ matrix.T.astype(np.float64)) ** 2, axis=1)
