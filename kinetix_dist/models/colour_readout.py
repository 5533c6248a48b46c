"""Logits from what obeys them: a head reads the joints or thrusters of its colour, next to the output of the actor.

    of a row of a joint      u = tanh(Dense([x_from, x_to, joint]))     two rows a joint, one from either end
    of a thruster            u = tanh(Dense([x_owner, thruster]))
    of a colour              s = sum of u over its rows
    logits of its head       Dense(tanh(Dense([s, actor])))             actor: the last layer of the actor's tower

Weights are shared by all motor colours, and by all thruster colours: what is learned of a motor holds for whichever
colour it has, and two levels that differ by a swap of colours have the same logits, swapped. In the paper's network a
pooled vector has to say which colour sits where. After per-actuator outputs for many bodies (NerveNet, Wang et al.
2018; MetaMorph, Gupta et al. 2022).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS
from kinetix_dist.models.linear import linear, stored_gradient

orthogonal = nn.initializers.orthogonal


def check_heads(head_sizes: Sequence[int]) -> None:
    """Raises ValueError unless each colour has a head, motors first, and those of a kind are alike."""
    motors, thrusters = head_sizes[:NUM_MOTOR_COLOURS], head_sizes[NUM_MOTOR_COLOURS:]
    if len(thrusters) != NUM_THRUSTER_COLOURS or len(set(motors)) > 1 or len(set(thrusters)) > 1:
        raise ValueError(
            f"PolicyConfig.read_out is 'colour', but the actions have outputs of {tuple(head_sizes)} numbers and not "
            f"one a colour ({NUM_MOTOR_COLOURS} of motors, {NUM_THRUSTER_COLOURS} of thrusters); "
            "set it to 'pooled' or use env.action_space 'multi_discrete'"
        )


def sum_by_colour(rows: Array, colours: Array) -> Array:
    """[B, C, F] in the type of `rows`, summed in float32, from rows [B, K, F] and colours [B, K, C] float32, one-hot.

    A row without a colour is in no sum.
    """
    total = jnp.zeros((rows.shape[0], colours.shape[2], rows.shape[2]), jnp.float32)
    for row in range(rows.shape[1]):
        total = total + colours[:, row, :, None] * rows[:, row, None].astype(jnp.float32)
    return total.astype(rows.dtype)


class ColourReadOut(nn.Module):
    """(sums of motor colours [B, 4, F], of thruster colours [B, 2, F], actor [B, F]) -> logits of each head."""

    hidden_size: int
    head_sizes: tuple[int, ...]
    output_gain: float

    @nn.compact
    def __call__(self, motors: Array, thrusters: Array, actor: Array) -> tuple[Array, ...]:
        of_motors = self._logits("motor", motors, actor, self.head_sizes[0])
        of_thrusters = self._logits("thruster", thrusters, actor, self.head_sizes[-1])
        return tuple(logits[:, colour] for logits in (of_motors, of_thrusters) for colour in range(logits.shape[1]))

    def _logits(self, kind: str, sums: Array, actor: Array, num_choices: int) -> Array:
        """[B, colours, choices] float32"""
        sum_kernel = self.param(f"{kind}_sum_kernel", orthogonal(1.0), (sums.shape[-1], self.hidden_size), jnp.float32)
        actor_kernel = self.param(
            f"{kind}_actor_kernel", orthogonal(1.0), (actor.shape[-1], self.hidden_size), jnp.float32
        )
        bias = self.param(f"{kind}_bias", nn.initializers.zeros, (self.hidden_size,), jnp.float32)
        of_actor = linear(actor, actor_kernel) + bias.astype(actor.dtype)
        hidden = jnp.tanh(linear(sums, sum_kernel) + of_actor[:, None])
        output = nn.Dense(num_choices, kernel_init=orthogonal(self.output_gain), name=f"{kind}_output")
        # Small: float32 keeps log-probabilities exact. Stored, else the sum over the batch computes the loss's gradient
        # for each of its columns.
        return stored_gradient(output(hidden.astype(jnp.float32)))
