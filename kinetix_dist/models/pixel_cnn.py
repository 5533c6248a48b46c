"""The policy of pictures, the paper's: two convolutions, then actor and critic.

    [B, 125, 125, 3] uint8 -> 16 of 8 x 8, stride 4, relu -> 32 of 4 x 4, stride 2, relu -> 16 x 16 x 32 -> towers

Pictures become numbers of 0 to 1 here, in the type of the activations.
"""

from __future__ import annotations

from typing import Any

from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.models.gru import apply_towers
from kinetix_dist.models.hidden_units import note_units
from kinetix_dist.models.towers import TANH_GAIN, Towers

# (features, side of the kernel, stride)
CONVOLUTIONS = ((16, 8, 4), (32, 4, 2))

# Device memory that a sample of a minibatch takes while gradients are computed: 485 kB in float32 and 508 kB in
# bfloat16 as compiled for a CPU, picture not counted, and a margin.
SAMPLE_BYTES = 600_000


class PixelCnn(nn.Module):
    """Pictures [B, rows, columns, 3] uint8 -> (outputs of each head [B, k] float32, value [B] float32)."""

    hidden_size: int
    hidden_layers: int
    head_sizes: tuple[int, ...]
    dtype: Any
    memory_size: int = 0  # see gru.py; 0: none

    @nn.compact
    def __call__(self, obs: Array, memory: Array | None = None, *, is_first: Array | None = None) -> Any:
        x = obs.astype(self.dtype) * (1 / 255)
        for number, (features, side, stride) in enumerate(CONVOLUTIONS):
            convolve = nn.Conv(
                features,
                (side, side),
                (stride, stride),
                kernel_init=nn.initializers.orthogonal(TANH_GAIN),
                dtype=self.dtype,
                name=f"convolution_{number}",
            )
            x = nn.relu(convolve(x))
            note_units(self, f"convolution_{number}", x)
        embedding = x.reshape(x.shape[0], -1)
        towers = Towers(self.hidden_size, self.hidden_layers, self.head_sizes, name="towers")
        return apply_towers(towers, embedding, memory, is_first, self.memory_size)
