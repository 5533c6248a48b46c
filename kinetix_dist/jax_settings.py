"""Settings of JAX with which commands run: the one list, checked before anything is computed.

JAX takes its settings from the environment (`JAX_NUMPY_RANK_PROMOTION=raise`) or from `jax.config`. Some end a program
in the middle, others change what it computes. A row here makes such a value one line at the start.
"""

from __future__ import annotations

import dataclasses

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
