"""The parts of a layer (models/layer.py, whose formulas and arguments these are) by kernels for Hopper GPUs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from jax2d.scene import Array
from kinetix_dist.models.kernels.attention import attention_branch
from kinetix_dist.models.kernels.encoders import encode
from kinetix_dist.models.kernels.feed_forward import feed_forward_branch
from kinetix_dist.models.kernels.gate import gate
from kinetix_dist.models.kernels.messages import add_messages, pack_ends
from kinetix_dist.models.layer import LayerParts

if TYPE_CHECKING:
    from kinetix_dist.env.observations.entities import EntityObs


def _encode(
    features: Sequence[Array], kernels: Sequence[Array], biases: Sequence[Array], num_others: int, dtype: Any
) -> Array:
    del dtype  # the one that `support` asks for
    return encode(features, kernels, biases, num_others)


def _attention_branch(x: Array, mask_words: Array, *arguments: Any) -> tuple[Array, Array]:
    *parameters, heads = arguments
    del heads  # those that `support` asks for
    return attention_branch(x, mask_words, *parameters)


def _ends(obs: EntityObs) -> tuple[Array, Array]:
    return (
        pack_ends(obs.joint_from, obs.joint_to, obs.joint_mask),
        pack_ends(obs.thruster_owner, None, obs.thruster_mask),
    )


def _add_messages(x: Array, ends: tuple[Array, Array], *terms_and_kernels: Array) -> Array:
    return add_messages(x, *ends, *terms_and_kernels)


FUSED = LayerParts(
    encode=_encode,
    attention_branch=_attention_branch,
    feed_forward_branch=feed_forward_branch,
    gate=gate,
    ends=_ends,
    add_messages=_add_messages,
    joins_terms=False,
)
