"""Interface between an engine and what steps its worlds. Backends: `warp/ffi.py`, the kernel, and `xla/backend.py`."""

from __future__ import annotations

from typing import Any, Protocol

import jax
import numpy as np

from jax2d.effects import Effects
from jax2d.scene import BackendReport, Capacity, Controls, Scene, State
from jax2d.settings import Settings


class Backend(Protocol):
    """Steps batches of worlds. Packed tables are pytrees of its own whose leaves have the world axis last."""

    num_contact_slots: int
    numbers: Any  # what the settings amount to (`solver_numbers`), as the backend takes them; may be traced

    def pack_scene(self, scene: Scene) -> Any:
        """Tables of a batch of scenes, of which only what acts counts (`scene.only_what_acts`)."""
        ...

    def pack_state(self, state: State) -> Any: ...

    def unpack_state(self, packed: Any) -> State: ...

    def bodies(self, packed: Any) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(position [W, n, 2], angle [W, n], velocity [W, n, 2], angular velocity [W, n])."""
        ...

    def step_packed(self, scene: Any, state: Any, controls: Controls, num_steps: int) -> tuple[Any, BackendReport]:
        """`num_steps` steps of `settings.dt`; controls are batch-first and within their ranges."""
        ...


class BackendFactory(Protocol):
    """Makes a backend; raises ValueError for what it cannot do."""

    def __call__(
        self,
        capacity: Capacity,
        settings: Settings,
        dtype: np.dtype,
        effects: Effects,
        *,
        numbers: Any = None,
        report_contacts: bool = False,
    ) -> Backend:
        """`numbers`: in place of those of the settings, for programs that take them at run time. `report_contacts`:
        reports have `contacts`."""
        ...
