"""Action spaces: what an action array of a batch of worlds looks like, how to draw and to check one.

Three spaces, each with the same few methods, chosen by `EnvConfig.action_space`:

    multi_discrete  [W, 6] int32    four motor colours {0 off, 1 forward, 2 backward}, two thruster colours {0, 1 on}
    continuous      [W, 6] float32  four motor colours -1..1, two thruster colours 0..1
    discrete        [W]    int32    one of 11: motor colour forward (0-3), backward (4-7), nothing (8), thruster (9, 10)
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS

NUM_MOTOR_CHOICES = 3  # off, forward, backward
NUM_THRUSTER_CHOICES = 2  # off, on


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActionSpace:
    """A box of numbers `low <= action <= high` for each of `num_dimensions`; integers or floats.

    `is_flat` spaces have one number a world and no trailing axis: shape [W] instead of [W, num_dimensions].
    """

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]  # inclusive
    is_integer: bool
    is_flat: bool = False

    @property
    def num_dimensions(self) -> int:
        return len(self.low)

    @property
    def dtype(self) -> Any:
        return jnp.int32 if self.is_integer else jnp.float32

    @property
    def head_sizes(self) -> tuple[int, ...]:
        """Number of choices of each categorical head of a policy; empty for a continuous space."""
        if not self.is_integer:
            return ()
        return tuple(int(high) + 1 for high in self.high)

    def shape(self, num_worlds: int) -> tuple[int, ...]:
        return (num_worlds,) if self.is_flat else (num_worlds, self.num_dimensions)

    def sample(self, key: Array, num_worlds: int) -> Array:
        """Uniform actions, [W, num_dimensions] or [W]. Consumes the key."""
        shape = (num_worlds, self.num_dimensions)
        if self.is_integer:
            actions = jax.random.randint(key, shape, 0, jnp.asarray(self.high, jnp.int32) + 1, jnp.int32)
        else:
            low, high = jnp.asarray(self.low, jnp.float32), jnp.asarray(self.high, jnp.float32)
            actions = jax.random.uniform(key, shape, jnp.float32) * (high - low) + low
        return actions[:, 0] if self.is_flat else actions

    def in_range(self, actions: Array) -> Array:
        """bool, the shape of `actions`: which numbers the space allows. NaN is out of range."""
        low, high = np.asarray(self.low, self.dtype), np.asarray(self.high, self.dtype)
        if self.is_flat:
            low, high = low[0], high[0]
        return (actions >= low) & (actions <= high)

    def check(self, actions: Array, num_worlds: int) -> None:
        """Raises ValueError when shape or type are wrong, or (outside of jit, where values are known) a value is.

        Inside jit values cannot be looked at: `Environment.step` counts them in `StepInfo.invalid_actions`.
        """
        expected = self.shape(num_worlds)
        if tuple(np.shape(actions)) != expected:
            found = tuple(np.shape(actions))
            raise ValueError(f"actions have shape {found}; {self.name} actions of {num_worlds} worlds have {expected}")
        dtype = actions.dtype if hasattr(actions, "dtype") else np.asarray(actions).dtype
        kind = jnp.integer if self.is_integer else jnp.floating
        if not jnp.issubdtype(dtype, kind):
            wanted = "integers (int32)" if self.is_integer else "floats (float32)"
            raise ValueError(f"actions have type {dtype}; {self.name} actions are {wanted}")
        if isinstance(actions, jax.core.Tracer):
            return
        allowed = self.in_range(np.asarray(actions))
        if not allowed.all():
            index = tuple(int(i) for i in np.argwhere(~allowed)[0])
            dimension = 0 if self.is_flat else index[-1]
            raise ValueError(
                f"action {np.asarray(actions)[index]} at {list(index)} is out of range; "
                f"dimension {dimension} of {self.name} takes {self.low[dimension]:g} to {self.high[dimension]:g}"
            )


MULTI_DISCRETE = ActionSpace(
    name="multi_discrete",
    low=(0,) * (NUM_MOTOR_COLOURS + NUM_THRUSTER_COLOURS),
    high=(NUM_MOTOR_CHOICES - 1,) * NUM_MOTOR_COLOURS + (NUM_THRUSTER_CHOICES - 1,) * NUM_THRUSTER_COLOURS,
    is_integer=True,
)
CONTINUOUS = ActionSpace(
    name="continuous",
    low=(-1.0,) * NUM_MOTOR_COLOURS + (0.0,) * NUM_THRUSTER_COLOURS,
    high=(1.0,) * (NUM_MOTOR_COLOURS + NUM_THRUSTER_COLOURS),
    is_integer=False,
)
DISCRETE = ActionSpace(
    name="discrete",
    low=(0,),
    high=(2 * NUM_MOTOR_COLOURS + NUM_THRUSTER_COLOURS,),
    is_integer=True,
    is_flat=True,
)
ACTION_SPACES = {space.name: space for space in (MULTI_DISCRETE, CONTINUOUS, DISCRETE)}
