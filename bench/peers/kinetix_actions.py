"""What each discrete action of the public Kinetix package drives (in its own environment): JSON on stdout.

    python kinetix_actions.py

A list for actions 0 to 10 of what one motor of each colour (4) and one thruster of each colour (2) are told, as
`convert_discrete_actions` has it. This file uses nothing of the project.
"""

from __future__ import annotations

import json

import flax
import jax
import jax.numpy as jnp
from kinetix.environment.env_state import EnvParams, StaticEnvParams
from kinetix.environment.utils import convert_discrete_actions


@flax.struct.dataclass
class Bindings:
    """All that the conversion asks of a state."""

    motor_bindings: jax.Array
    thruster_bindings: jax.Array
    motor_auto: jax.Array


def main() -> None:
    static = StaticEnvParams()
    motors, thrusters = static.num_motor_bindings, static.num_thruster_bindings
    state = Bindings(
        motor_bindings=jnp.arange(motors),
        thruster_bindings=jnp.arange(thrusters),
        motor_auto=jnp.zeros(motors, bool),
    )
    numbers = range(2 * motors + 1 + thrusters)
    told = [convert_discrete_actions(number, state, static, EnvParams()).tolist() for number in numbers]
    print(json.dumps(told))


if __name__ == "__main__":
    main()
