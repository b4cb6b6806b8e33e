"""The numpy network of each variant."""

from __future__ import annotations

from cref_jax.runtime.network import VARIANTS, Actor, Encoder
from cref_jax.runtime.parkour import DepthLatent, ParkourActor
from cref_jax.runtime.tables import Table, Weights


def build_encoder(net: Table, weights: Weights, shape: tuple[int, int]) -> Encoder | DepthLatent:
    """Build the encoder of frames of this shape."""
    kind = DepthLatent if net.text("variant", VARIANTS) == "hpl" else Encoder
    return kind(net, weights, shape)


def build_actor(
    net: Table, weights: Weights, shape: tuple[int, int], size: int, actions: int
) -> Actor | ParkourActor:
    """Build the recurrent part for observations of this size."""
    if net.text("variant", VARIANTS) == "hpl":
        return ParkourActor(net, weights, size, actions)
    return Actor(net, weights, shape, size, actions)
