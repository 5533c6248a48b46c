"""Activations of hidden layers, which a network notes for measures of plasticity (`learner/plasticity.py`).

    _, noted = policy.apply(params, obs, mutable=list(COLLECTIONS))

A network notes units layer by layer and, before the outputs, the features of actor and critic. `Towers` does so for
its layers. In every other call nothing is computed for it.
"""

from __future__ import annotations

from flax import linen as nn

from jax2d.scene import Array

UNITS, FEATURES = "hidden_units", "features"
COLLECTIONS = (UNITS, FEATURES)


def note_units(module: nn.Module, layer: str, activations: Array, mask: Array | None = None) -> None:
    """Notes activations [..., units] of a layer; mask [...]: rows that count, None: all."""
    if module.is_mutable_collection(UNITS) and not module.is_initializing():
        module.sow(UNITS, f"{layer}_units", activations if mask is None else activations * mask[..., None])


def note_features(module: nn.Module, actor: Array, critic: Array) -> None:
    """Notes the features [B, units] from which the outputs are linear."""
    if module.is_mutable_collection(FEATURES) and not module.is_initializing():
        module.sow(FEATURES, "actor", actor)
        module.sow(FEATURES, "critic", critic)
