"""Interface of an action space: shape of actions, their effect on motors and thrusters, how a policy draws them.

A new action space is one file with an `ActionSpace` and its registration: docs/extending.md.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, Controls
from kinetix_dist import prng
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, Level, obeying_motors
from kinetix_dist.telemetry.recording import ActionName


class ActionDistribution(Protocol):
    """Distribution of a policy's actions in a space, given its outputs: [..., k] float32 of each k of `head_sizes`.

    bound: [..., dimensions] bool, see `ActionSpace.bound_heads`: dimensions that count in log-probability and entropy;
    None: all do. It is given only where the space has `bound_heads`.
    """

    stored_dtype: ClassVar[Any]  # in which trajectories keep actions

    @property
    def head_sizes(self) -> tuple[int, ...]:
        """k of each output of the policy."""
        ...

    @property
    def num_uniforms(self) -> int:
        """Random numbers that a sample takes."""
        ...

    def sample(self, outputs: tuple[Array, ...], uniforms: Array, *, bound: Array | None = None) -> tuple[Array, Array]:
        """(actions, their log-probability [...]) from uniform numbers [..., num_uniforms] in [0, 1)."""

    def log_prob_and_entropy(
        self, outputs: tuple[Array, ...], actions: Array, *, bound: Array | None = None
    ) -> tuple[Array, Array]:
        """(log-probability [...] of stored actions, entropy [...] in nats)."""

    def mode(self, outputs: tuple[Array, ...]) -> Array:
        """The most likely actions."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActionSpace(abc.ABC):
    """A box of numbers `low <= action <= high` for each of `num_dimensions`; integers or floats.

    `is_flat` spaces have one number a world and no trailing axis: shape [W] instead of [W, num_dimensions].
    """

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]  # inclusive
    is_integer: bool
    is_flat: bool = False
    noop: int = 0  # the number that drives nothing, in every dimension

    @property
    def distribution(self) -> ActionDistribution | None:
        """Distribution of policies; None: environments have this space, but no policy can be trained in it."""
        return None

    @abc.abstractmethod
    def colour_values(self, actions: Array, allowed: Array) -> tuple[Array, Array]:
        """Value of each colour: motors [W, 4] in -1..1, thrusters [W, 2] in 0..1; off where not `allowed`."""

    @property
    def action_names(self) -> tuple[ActionName, ...]:
        """Names of the dimensions and of their values, for recordings; a space that says nothing has numbers."""
        return tuple(ActionName(f"action {number}") for number in range(self.num_dimensions))

    @property
    def has_bound_heads(self) -> bool:
        """`bound_heads` differs between levels."""
        return type(self).bound_heads is not ActionSpace.bound_heads

    def bound_heads(self, levels: Level) -> Array | None:
        """[W, num_dimensions] bool: the dimensions that some motor or thruster of a level obeys.

        Nothing that happens in the level depends on the others. None: a space whose dimensions are not of one colour.
        """
        del levels
        return None

    @property
    def num_dimensions(self) -> int:
        return len(self.low)

    @property
    def dtype(self) -> Any:
        return jnp.int32 if self.is_integer else jnp.float32

    @property
    def stored_dtype(self) -> np.dtype:
        """Type in which data sets keep actions."""
        return np.dtype(self.dtype if self.distribution is None else self.distribution.stored_dtype)

    def shape(self, num_worlds: int) -> tuple[int, ...]:
        return (num_worlds,) if self.is_flat else (num_worlds, self.num_dimensions)

    def sample(self, key: Array, num_worlds: int) -> Array:
        """Uniform actions, [W, num_dimensions] or [W]. Consumes the key."""
        shape = (num_worlds, self.num_dimensions)
        if self.is_integer:
            actions = prng.randint(key, shape, 0, jnp.asarray(self.high, jnp.int32) + 1)
        else:
            low, high = jnp.asarray(self.low, jnp.float32), jnp.asarray(self.high, jnp.float32)
            actions = prng.uniform(key, shape) * (high - low) + low
        return actions[:, 0] if self.is_flat else actions

    def noop_actions(self, num_worlds: int) -> Array:
        """Actions that drive nothing (but `motor_auto` joints)."""
        return jnp.full(self.shape(num_worlds), self.noop, self.dtype)

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


MOTOR_NAMES = tuple(f"motor colour {colour}" for colour in range(NUM_MOTOR_COLOURS))
THRUSTER_NAMES = tuple(f"thruster colour {colour}" for colour in range(NUM_THRUSTER_COLOURS))


def bound_colours(levels: Level) -> Array:
    """[W, 6] bool, motor colours first: whether a motor or thruster of the level obeys it."""
    thrusters, obeys = levels.scene.thrusters, obeying_motors(levels)
    motors = jax.nn.one_hot(levels.motor_colour, NUM_MOTOR_COLOURS, dtype=bool) & obeys[..., None]
    thrusts = jax.nn.one_hot(levels.thruster_colour, NUM_THRUSTER_COLOURS, dtype=bool) & thrusters.active[..., None]
    return jnp.concatenate([motors.any(axis=-2), thrusts.any(axis=-2)], axis=-1)


def controls_of(
    space: ActionSpace, actions: Array, motor_colour: Array, motor_auto: Array, thruster_colour: Array
) -> tuple[Controls, Array]:
    """Controls of a batch of worlds and the number of actions out of range, [W] int32.

    actions [W, 6] or [W] (see action_spaces/), motor_colour and motor_auto [W, J], thruster_colour [W, T].
    """
    allowed = space.in_range(actions)
    colour_motor, colour_thruster = space.colour_values(actions, allowed)
    motor = jnp.take_along_axis(colour_motor, motor_colour, axis=1)
    motor = jnp.where(motor_auto, 1.0, motor)
    thruster = jnp.take_along_axis(colour_thruster, thruster_colour, axis=1)
    num_invalid = (~allowed).reshape(allowed.shape[0], -1).sum(axis=1, dtype=jnp.int32)
    return Controls(motor=motor, thruster=thruster), num_invalid
